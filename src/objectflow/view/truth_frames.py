"""The ground truth of a data set's rows as viewer frames."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence

import numpy as np

from objectflow import geometry
from objectflow.dataset.pairing import pair_of_frames
from objectflow.dataset.schema import PairRow, SequenceRow
from objectflow.view.viewer_frames import ShownObject, ViewerFrame, caption

FRAME_RATE = 60.0
"""Frames per second of the simulation, in which sequence rows are numbered."""

MIN_DISPLACEMENT = 0.002
"""Smallest displacement that is shown as an arrow, metres."""


def pair_row_frames(row: PairRow) -> tuple[ViewerFrame, ViewerFrame]:
    """Both frames of a pair with true masks, flow and poses; the camera is static."""
    return _viewer_frames(row, (0, 1), (None, None))


def sequence_frames(rows: Sequence[SequenceRow]) -> Iterator[ViewerFrame]:
    """The frames of one sequence in order, each with the motion since the previous frame."""
    for index, (prev, curr) in enumerate(itertools.pairwise(rows)):
        seconds = tuple((row.frame - rows[0].frame) / FRAME_RATE for row in (prev, curr))
        before, after = _viewer_frames(pair_of_frames(prev, curr), (prev.frame, curr.frame), (seconds[0], seconds[1]))
        if index == 0:
            yield before
        yield after


def _viewer_frames(
    row: PairRow, numbers: tuple[int, int], seconds: tuple[float | None, float | None]
) -> tuple[ViewerFrame, ViewerFrame]:
    before, after = [], []
    for obj in row.objects:
        name = f"{obj.category} {obj.label}"
        before.append(ShownObject(obj.label, name, obj.prev_pose))
        path = np.stack([obj.center + obj.translation, obj.center])
        moved = obj.in_both and float(np.linalg.norm(obj.translation)) > MIN_DISPLACEMENT
        text = caption(path, obj.prev_pose, obj.curr_pose)
        after.append(ShownObject(obj.label, name, obj.curr_pose, path if moved else None, text))
    points = geometry.back_project(row.curr.depth, row.curr.camera)
    motions = {obj.label: obj.prev_T_curr(raw=True) for obj in row.objects if obj.in_both}
    flow = geometry.flow_from_motions(points, row.curr_labels, motions)
    return (
        ViewerFrame(
            numbers[0], seconds[0], row.prev, np.eye(4), row.prev_labels.astype(np.uint16), objects=tuple(before)
        ),
        ViewerFrame(
            numbers[1], seconds[1], row.curr, np.eye(4), row.curr_labels.astype(np.uint16), flow, tuple(after)
        ),
    )
