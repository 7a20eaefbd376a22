"""The truth of a pair in the form that the metrics need."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from objectflow import geometry
from objectflow.dataset.moving_objects import keep_labels, moving_labels
from objectflow.dataset.schema import PairRow
from objectflow.errors import DatasetError
from objectflow.frame import RgbdFrame
from objectflow.typing import BoolMask, Float32Array, Float64Array, Int64Array, LabelImage

MIN_DISPLACEMENT = 0.005
"""Metres: minimum mean displacement of a moving object's visible pixels, relative to the background."""


@dataclass(frozen=True, eq=False)
class TrueObject:
    """One object's true motion, in the camera frame.

    Attributes:
        label: its value in the true labels.
        center: (3,) metres, X, in the current frame; on every symmetry axis.
        prev_T_curr: (4, 4).
        axes: (A, 3) symmetry axes in the current camera frame.
        orders: of each axis, n >= 2 for C_n or 0 for continuous.
        in_both: whether it is visible in both frames.
        rotation_known: False if only the translation is known.
    """

    label: int
    center: Float64Array
    prev_T_curr: Float64Array
    axes: Float64Array
    orders: tuple[int, ...]
    in_both: bool
    rotation_known: bool = True


@dataclass(frozen=True, eq=False)
class PairTruth:
    """The truth of one pair, on the current frame's pixels.

    Attributes:
        key: the pair's name in its set.
        scene: pairs of the same scene are not independent.
        labels: (H, W) int32: the regions to find; 0 = background.
        scene_flow: (H, W, 3) float32 metres, NaN where depth is missing.
        objects: every object in `labels`.
        masked: (H, W) bool: pixels of objects that are visible in both frames.
        moving: the labels of objects that move relative to the background.
        background_prev_T_curr: (4, 4) the camera's own motion, None for a static camera.
    """

    key: str
    scene: str
    labels: LabelImage
    scene_flow: Float32Array
    objects: tuple[TrueObject, ...]
    masked: BoolMask
    moving: frozenset[int]
    background_prev_T_curr: Float64Array | None = None


def make_pair_truth(
    key: str,
    curr: RgbdFrame,
    labels: LabelImage,
    objects: Sequence[TrueObject],
    *,
    background_prev_T_curr: Float64Array | None = None,
    scene: str | None = None,
    min_displacement: float = MIN_DISPLACEMENT,
) -> PairTruth:
    """Compute the flow and the masks from labels and motions.

    Args:
        key: the pair's name.
        curr: the current frame.
        labels: (H, W) int32.
        objects: one for each label; those without a pixel are dropped.
        background_prev_T_curr: (4, 4), None for a static camera.
        scene: `key` if None.
        min_displacement: of moving objects, metres; a negative value marks all objects as moving.

    Raises:
        DatasetError: a label without an object, or labels of another size than the frame.
    """
    if labels.shape != curr.depth.shape:
        raise DatasetError(f"{key}: true labels are {labels.shape}, the frame is {curr.depth.shape}")
    present = set(np.flatnonzero(np.bincount(labels.ravel())).tolist()) - {0}
    stray = present - {obj.label for obj in objects}
    if stray:
        raise DatasetError(f"{key}: true labels {sorted(stray)} belong to no object")
    seen = tuple(obj for obj in objects if obj.label in present)
    points = geometry.back_project(curr.depth, curr.camera)
    flow, shifts = _flow_and_shifts(points, labels, seen, background_prev_T_curr)
    both = np.zeros(int(labels.max(initial=0)) + 1, np.bool_)
    both[[obj.label for obj in seen if obj.in_both]] = True
    return PairTruth(
        key=key,
        scene=key if scene is None else scene,
        labels=labels,
        scene_flow=flow,
        objects=seen,
        masked=both[labels],
        moving=frozenset(obj.label for obj, shift in zip(seen, shifts, strict=True) if shift > min_displacement),
        background_prev_T_curr=background_prev_T_curr,
    )


def truth_of_row(row: PairRow) -> PairTruth:
    """The truth of a generated pair; rotations are reduced by symmetry, as in the paper.

    If the row holds the camera's motion, static objects are background.

    Raises:
        DatasetError: a label without an object.
    """
    kept, camera = moving_labels(row), row.camera_motion
    return make_pair_truth(
        row.key,
        row.curr,
        row.curr_labels if camera is None else keep_labels(row.curr_labels, kept),
        [
            TrueObject(
                label=obj.label,
                center=obj.center,
                prev_T_curr=obj.prev_T_curr(),
                axes=np.array([axis.axis for axis in obj.symmetry]).reshape(-1, 3) @ obj.curr_pose[:3, :3].T,
                orders=tuple(axis.order for axis in obj.symmetry),
                in_both=obj.in_both,
            )
            for obj in row.objects
            if obj.label in kept
        ],
        background_prev_T_curr=None if camera is None or np.array_equal(camera, np.eye(4)) else camera,
        scene=row.scene,
        min_displacement=MIN_DISPLACEMENT if camera is None else -1.0,
    )


def _flow_and_shifts(
    points: Float32Array,
    labels: LabelImage,
    objects: Sequence[TrueObject],
    background_prev_T_curr: Float64Array | None,
) -> tuple[Float32Array, list[float]]:
    """The flow, (H, W, 3), and each object's mean displacement in metres relative to the background's motion.

    Each object is processed on its own pixels instead of the whole image, since this dominates the scoring time.
    """
    flow = geometry.flow_from_motions(points, labels, {}, background_prev_T_curr)
    pixels = _pixels_by_label(labels)
    flat_flow, flat_points = flow.reshape(-1, 3), points.reshape(-1, 3)
    shifts = []
    for obj in objects:
        where = pixels[obj.label]
        static = flat_flow[where]
        ones = np.ones((1, len(where)), np.int32)
        moved = geometry.flow_from_motions(flat_points[where][None], ones, {1: obj.prev_T_curr})[0]
        flat_flow[where] = moved
        distance = np.linalg.norm((moved - static).astype(np.float64), axis=1)
        known = distance[np.isfinite(distance)]
        shifts.append(float(known.mean()) if len(known) else 0.0)
    return flow, shifts


def _pixels_by_label(labels: LabelImage) -> list[Int64Array]:
    """Flat indices of each label's pixels in image order, by one sort for all labels."""
    flat = labels.ravel()
    order = np.argsort(flat.astype(np.uint16) if flat.max(initial=0) < 1 << 16 else flat, kind="stable")
    counts = np.bincount(flat)
    return np.split(order, np.cumsum(counts)[:-1])
