"""Label images: numbering and the flow of their rigid motions."""

from __future__ import annotations

import dataclasses

import numpy as np

from objectflow import geometry
from objectflow.motion import ObjectMotion
from objectflow.typing import Float32Array, LabelImage


def relabel_present(
    labels: LabelImage, objects: tuple[ObjectMotion, ...]
) -> tuple[LabelImage, tuple[ObjectMotion, ...]]:
    """Count each object's pixels and number anew from 1: objects without pixels go, and labels without an object."""
    counts = np.bincount(labels.ravel(), minlength=1 + max((obj.id for obj in objects), default=0))
    kept = [obj for obj in objects if counts[obj.id]]
    number = np.zeros(len(counts), np.int32)
    number[[obj.id for obj in kept]] = np.arange(1, len(kept) + 1)
    renamed = tuple(dataclasses.replace(obj, id=int(number[obj.id]), pixels=int(counts[obj.id])) for obj in kept)
    return number[labels], renamed


def rigid_flow(objects: tuple[ObjectMotion, ...], labels: LabelImage, points: Float32Array) -> Float32Array:
    """The flow that the objects' motions make; shapes as in `pixel_flow`."""
    return geometry.flow_from_motions(points, labels, {obj.id: obj.prev_T_curr for obj in objects})
