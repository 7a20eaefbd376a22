"""Label images: numbering, and the flow of the rigid motions of their objects."""

from __future__ import annotations

import dataclasses

import numpy as np

from objectflow import geometry
from objectflow.motion import ObjectMotion, SceneMotion
from objectflow.typing import Float32Array, LabelImage

Objects = tuple[ObjectMotion, ...]
"""Objects of one label image, in order of their ids."""


def relabel_present(labels: LabelImage, objects: Objects) -> tuple[LabelImage, Objects]:
    """Number objects from 1 and count their pixels; drop objects without pixels and labels without an object."""
    counts = np.bincount(labels.ravel(), minlength=1 + max((obj.id for obj in objects), default=0))
    kept = [obj for obj in objects if counts[obj.id]]
    number = np.zeros(len(counts), np.int32)
    number[[obj.id for obj in kept]] = np.arange(1, len(kept) + 1)
    renamed = tuple(dataclasses.replace(obj, id=int(number[obj.id]), pixels=int(counts[obj.id])) for obj in kept)
    if (number == np.arange(len(number))).all():
        return labels.astype(np.int32, copy=False), renamed
    return number[labels], renamed


def with_surface_centers(labels: LabelImage, objects: Objects, points: Float32Array) -> Objects:
    """The objects with the centres of their visible surfaces; see `ObjectMotion.center`.

    Args:
        labels: (H, W) int32.
        objects: of the labels; one whose pixels have no depth keeps its centre.
        points: (H, W, 3) metres of the current frame, NaN where depth is missing.
    """
    centers = geometry.surface_centers(points, labels)
    return tuple(dataclasses.replace(obj, center=centers.get(obj.id, obj.center)) for obj in objects)


def rigid_flow(objects: Objects, labels: LabelImage, points: Float32Array) -> Float32Array:
    """(H, W, 3) metres: the flow of the objects' motions on points (H, W, 3); 0 off the objects, NaN without depth."""
    return geometry.flow_from_motions(points, labels, {obj.id: obj.prev_T_curr for obj in objects})


def unknown_motion(shape: tuple[int, ...]) -> SceneMotion:
    """The result (H, W) where the camera's motion is unknown: no objects, and no flow anywhere."""
    flow = np.full((*shape, 3), np.nan, np.float32)
    return SceneMotion(np.zeros(shape, np.int32), flow, camera_known=False)
