"""Which objects of a pair move, where most do not: in sets with clutter and moving cameras (preset `wild`).

A row that holds the camera's motion also holds objects that stand still. They keep their labels and their entries in
the table, whose motion is then the camera's, but networks and metrics take them for background.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from objectflow import geometry
from objectflow.dataset.schema import PairRow

MIN_SHIFT, MIN_ROTATION = 0.002, np.radians(0.5)
"""Metres and radians. An object moves if its centre shifts or it turns further than this in the world. Generated
static objects stand exactly still, and moving ones move further (`objectflow.synth.generation.frame_pairs`)."""


def has_moved(prev_pose: ArrayLike, curr_pose: ArrayLike, camera_motion: ArrayLike) -> bool:
    """Whether an object moved against the world.

    Args:
        prev_pose, curr_pose: (4, 4) `camera_T_object` in the two frames.
        camera_motion: (4, 4) `prev_T_curr` of the world.
    """
    prev = np.asarray(prev_pose, dtype=np.float64)
    still = np.asarray(camera_motion, dtype=np.float64) @ np.asarray(curr_pose, dtype=np.float64)
    shift = float(np.linalg.norm(prev[:3, 3] - still[:3, 3]))
    return shift > MIN_SHIFT or float(geometry.rotation_angle(prev[:3, :3] @ still[:3, :3].T)) > MIN_ROTATION


def moving_labels(row: PairRow) -> frozenset[int]:
    """The labels of the objects that count as such: those that move, or all where the row has no camera motion."""
    camera = row.camera_motion
    return frozenset(
        obj.label for obj in row.objects if camera is None or has_moved(obj.prev_pose, obj.curr_pose, camera)
    )


def without_still(row: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """The entries of a stored row's object table that count as objects; see `moving_labels`."""
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
    """A label image in which only some labels are left; the others become background."""
    return np.where(np.isin(labels, list(kept)), labels, labels.dtype.type(0))
