"""The truth of a data set's rows as moments for a viewer."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence

import numpy as np

from objectflow import geometry
from objectflow.dataset.pairing import pair_of_frames
from objectflow.dataset.schema import PairRow, SequenceRow
from objectflow.view.viewer_frames import ShownObject, ViewerFrame, caption

FRAME_RATE = 60.0
"""Frames a second of the simulation: rows of sequences count its frames."""

MOVED = 0.002
"""Metres: what went less far gets no arrow."""


def row_moments(row: PairRow) -> tuple[ViewerFrame, ViewerFrame]:
    """Both frames of a pair with their true masks, flow and poses; the camera stands still."""
    return _moments(row, (0, 1), (None, None))


def sequence_moments(rows: Sequence[SequenceRow]) -> Iterator[ViewerFrame]:
    """The frames of one sequence, in order, each with the motion since the one before."""
    for index, (prev, curr) in enumerate(itertools.pairwise(rows)):
        seconds = tuple((row.frame - rows[0].frame) / FRAME_RATE for row in (prev, curr))
        before, after = _moments(pair_of_frames(prev, curr), (prev.frame, curr.frame), (seconds[0], seconds[1]))
        if index == 0:
            yield before
        yield after


def _moments(
    row: PairRow, numbers: tuple[int, int], seconds: tuple[float | None, float | None]
) -> tuple[ViewerFrame, ViewerFrame]:
    before, after = [], []
    for obj in row.objects:
        name = f"{obj.category} {obj.label}"
        before.append(ShownObject(obj.label, name, obj.prev_pose))
        way = np.stack([obj.center + obj.translation, obj.center])
        far = obj.in_both and float(np.linalg.norm(obj.translation)) > MOVED
        words = caption(way, obj.prev_pose, obj.curr_pose)
        after.append(ShownObject(obj.label, name, obj.curr_pose, way if far else None, words))
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
