"""Moving and static objects of a pair, in data sets with clutter and moving cameras (preset `clutter`).

Rows with a camera motion also contain static objects. These keep their labels and their entries in the object table,
with the motion of the camera, but networks and metrics treat them as background.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from objectflow.dataset.schema import PairRow
from objectflow.geometry.moved import is_moving

MIN_SHIFT, MIN_ROTATION = 0.002, np.radians(0.5)
"""Metres and radians: an object moves if its displacement or rotation in the world exceeds one of these. Generated
static objects do not move at all, and moving ones move further (`objectflow.synth.generation.frame_pairs`)."""


def has_moved(prev_pose: ArrayLike, curr_pose: ArrayLike, camera_motion: ArrayLike) -> bool:
    """Whether an object moved relative to the world.

    Args:
        prev_pose, curr_pose: (4, 4) `camera_T_object` in the two frames.
        camera_motion: (4, 4) `prev_T_curr` of the world.
    """
    prev = np.asarray(prev_pose, dtype=np.float64)
    static = np.asarray(camera_motion, dtype=np.float64) @ np.asarray(curr_pose, dtype=np.float64)
    rotation, shift = prev[:3, :3] @ static[:3, :3].T, prev[:3, 3] - static[:3, 3]
    return bool(is_moving(rotation, shift, MIN_SHIFT, lever_arm=MIN_SHIFT / MIN_ROTATION))


def moving_labels(row: PairRow) -> frozenset[int]:
    """The labels of the objects that are not background: the moving ones, or all if the row has no camera motion."""
    camera = row.camera_motion
    return frozenset(
        obj.label for obj in row.objects if camera is None or has_moved(obj.prev_pose, obj.curr_pose, camera)
    )


def without_static(row: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """The entries in the object table of a stored row that are not background; see `moving_labels`."""
    entries, camera = list(row["objects"]), row.get("camera_motion")
    if camera is None:
        return entries
    motion = np.reshape(camera, (4, 4))
    return [
        entry
        for entry in entries
        if has_moved(np.reshape(entry["prev_pose"], (4, 4)), np.reshape(entry["curr_pose"], (4, 4)), motion)
    ]


def keep_labels(labels: NDArray[Any], kept: frozenset[int] | set[int]) -> NDArray[Any]:
    """A label image with only the given labels; the others become background."""
    return np.where(np.isin(labels, list(kept)), labels, labels.dtype.type(0))
