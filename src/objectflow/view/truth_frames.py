"""The ground truth of a data set's rows as viewer frames."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence

import numpy as np

from objectflow import geometry
from objectflow.dataset.pairing import pair_of_frames
from objectflow.dataset.row_motion import motion_of_row
from objectflow.dataset.schema import PairRow, SequenceRow
from objectflow.motion.words import motion_caption
from objectflow.typing import Float64Array
from objectflow.view.viewer_frames import ShownObject, ViewerFrame

FRAME_RATE = 60.0
"""Frames per second of the simulation, in which sequence rows are numbered."""


def pair_row_frames(row: PairRow) -> tuple[ViewerFrame, ViewerFrame]:
    """Both frames of a pair with true masks, flow and poses."""
    camera = np.eye(4) if row.camera_motion is None else row.camera_motion
    return _viewer_frames(row, (0, 1), (None, None), (np.eye(4), camera))


def sequence_frames(rows: Sequence[SequenceRow]) -> Iterator[ViewerFrame]:
    """The frames of one sequence in order, each with the motion since the previous frame; the camera is static."""
    poses = (np.eye(4), np.eye(4))
    for index, (prev, curr) in enumerate(itertools.pairwise(rows)):
        seconds = tuple((row.frame - rows[0].frame) / FRAME_RATE for row in (prev, curr))
        pair = pair_of_frames(prev, curr)
        before, after = _viewer_frames(pair, (prev.frame, curr.frame), (seconds[0], seconds[1]), poses)
        if index == 0:
            yield before
        yield after


def _viewer_frames(
    row: PairRow,
    numbers: tuple[int, int],
    seconds: tuple[float | None, float | None],
    world_T_camera: tuple[Float64Array, Float64Array],
) -> tuple[ViewerFrame, ViewerFrame]:
    motion = motion_of_row(row)
    found = {obj.id: obj for obj in motion.objects}
    before, after = [], []
    for obj in row.objects:
        name = f"{obj.category} {obj.label}"
        before.append(ShownObject(obj.label, name, world_T_camera[0] @ obj.prev_pose))
        pose = world_T_camera[1] @ obj.curr_pose
        moved = found.get(obj.label)
        if moved is None or not moved.moving:
            after.append(ShownObject(obj.label, name, pose))
            continue
        path = geometry.transform(world_T_camera[1], np.stack([moved.prev_center, moved.center]))
        after.append(ShownObject(obj.label, name, pose, path, motion_caption(moved)))
    prev_ids, curr_ids = (labels.astype(np.uint16) for labels in (row.prev_labels, row.curr_labels))
    return (
        ViewerFrame(numbers[0], seconds[0], row.prev, world_T_camera[0], prev_ids, objects=tuple(before)),
        ViewerFrame(
            numbers[1], seconds[1], row.curr, world_T_camera[1], curr_ids, motion.own_flow(row.curr), tuple(after)
        ),
    )
