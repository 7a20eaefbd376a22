"""Pairs from two frames of one scene: the object table, with motions back in time, reduced by symmetry."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from objectflow import geometry
from objectflow.dataset.schema import FrameObject, PairObject, PairRow, SequenceRow
from objectflow.errors import DatasetError
from objectflow.geometry.symmetry import reduce_motion
from objectflow.typing import LabelImage


def pair_objects(
    prev: Sequence[FrameObject],
    curr: Sequence[FrameObject],
    prev_labels: LabelImage,
    curr_labels: LabelImage,
) -> tuple[PairObject, ...]:
    """The object table of a pair: every object that is visible in at least one of the frames.

    Args:
        prev, curr: all objects of the scene in each frame, in the same order, poses in the camera frame.
        prev_labels, curr_labels: (H, W) int32.

    Raises:
        DatasetError: the two frames do not hold the same objects.
    """
    if [(obj.label, obj.model) for obj in prev] != [(obj.label, obj.model) for obj in curr]:
        raise DatasetError("two frames with different objects make no pair")
    in_prev, in_curr = set(np.unique(prev_labels).tolist()), set(np.unique(curr_labels).tolist())
    return tuple(
        _motion(before, now, in_both=now.label in in_prev and now.label in in_curr)
        for before, now in zip(prev, curr, strict=True)
        if now.label in in_prev or now.label in in_curr
    )


def pair_of_frames(prev: SequenceRow, curr: SequenceRow, key: str | None = None, scene: str | None = None) -> PairRow:
    """Combine two frames of a sequence into a pair.

    Args:
        prev, curr: the frames.
        key: of the pair; by default "test-000003/30" for the current frame 30.
        scene: by default the name of the sequence.

    Raises:
        DatasetError: frames of different sequences.
    """
    if prev.sequence != curr.sequence:
        raise DatasetError(f"frames of sequences {prev.sequence} and {curr.sequence} make no pair")
    camera_motion = None
    if prev.world_T_camera is not None and curr.world_T_camera is not None:
        camera_motion = geometry.inverse(prev.world_T_camera) @ curr.world_T_camera
    return PairRow(
        key=key or f"{curr.sequence}/{curr.frame}",
        scene=scene or curr.sequence,
        prev=prev.image,
        prev_labels=prev.labels,
        curr=curr.image,
        curr_labels=curr.labels,
        objects=pair_objects(prev.objects, curr.objects, prev.labels, curr.labels),
        camera_motion=camera_motion,
    )


def _motion(prev: FrameObject, curr: FrameObject, *, in_both: bool) -> PairObject:
    raw = prev.pose[:3, :3] @ curr.pose[:3, :3].T
    reduced = reduce_motion(prev.pose[:3, :3], curr.pose[:3, :3], curr.symmetry)
    return PairObject(
        label=curr.label,
        category=curr.category,
        model=curr.model,
        center=curr.pose[:3, 3].copy(),
        translation=prev.pose[:3, 3] - curr.pose[:3, 3],
        rotation_vector=geometry.so3_log(reduced),
        raw_rotation_vector=geometry.so3_log(raw),
        symmetry=curr.symmetry,
        prev_pose=prev.pose,
        curr_pose=curr.pose,
        in_both=in_both,
    )
