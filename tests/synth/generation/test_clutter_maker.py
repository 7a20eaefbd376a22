"""Rows of clutter scenes: consistent, of all kinds, reproducible."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest

from objectflow import geometry
from objectflow.dataset.check import contradictions
from objectflow.dataset.moving_objects import moving_labels
from objectflow.dataset.schema import PairRow, SequenceRow
from objectflow.dataset.warp_check import warp_errors
from objectflow.errors import DatasetError
from objectflow.synth.generation.clutter_maker import ClutterScenes
from objectflow.synth.generation.tasks import Task
from objectflow.synth.scenes.clutter_scene import SCENE, ClutterSettings
from objectflow.synth.scenes.sequence_actions import STEP

SMALL = ClutterSettings(replace(SCENE, objects=(2, 5), width=160, height=120, focal=(110.0, 150.0)))


@pytest.fixture(scope="module")
def rows() -> list[PairRow]:
    make = ClutterScenes(0, "val", replace(SMALL, motionless=0.4, moving_camera=0.5), samples=1)()
    made = [row for scene in range(8) for row in make(Task("pairs", scene)).rows]
    return [PairRow.from_dict(row) for row in made]


def test_rows_are_consistent_and_of_all_kinds(rows: list[PairRow]) -> None:
    assert [contradictions(row) for row in rows] == [[]] * len(rows)
    movers = [len(moving_labels(row)) for row in rows]
    cameras = [not np.array_equal(row.camera_motion, np.eye(4)) for row in rows]
    assert 0 in movers
    assert max(movers) > 0
    assert set(cameras) == {False, True}


def test_pixels_move_by_the_motions_of_the_row_including_the_background(rows: list[PairRow]) -> None:
    for row in rows:
        assert row.camera_motion is not None
        errors = warp_errors(row, raw=True)
        assert np.median(np.abs(errors.depth)) < 0.001
        # Background: surfaces that are visible in both frames, compared at the nearest pixel.
        points = geometry.back_project(row.curr.depth, row.curr.camera)[row.curr_labels == 0].astype(np.float64)
        points = points[np.isfinite(points).all(-1)]
        before = geometry.transform(row.camera_motion, points)
        column, line = np.rint(geometry.project(before, row.prev.camera)).astype(int).T
        height, width = row.prev.depth.shape
        inside = (column >= 0) & (column < width) & (line >= 0) & (line < height)
        seen = row.prev.depth[line[inside], column[inside]]
        background = row.prev_labels[line[inside], column[inside]] == 0
        difference = np.abs(seen - before[inside, 2])[background & (seen > 0)]
        if len(difference) > 500:
            assert np.median(difference) < 0.01


def test_without_motion_and_with_a_static_camera_both_frames_are_equal(rows: list[PairRow]) -> None:
    static = [row for row in rows if np.array_equal(row.camera_motion, np.eye(4)) and not moving_labels(row)]
    assert static
    for row in static:
        np.testing.assert_array_equal(row.prev.color, row.curr.color)
        np.testing.assert_array_equal(row.prev.depth, row.curr.depth)


def test_the_same_seed_gives_the_same_row(rows: list[PairRow]) -> None:
    make = ClutterScenes(0, "val", replace(SMALL, motionless=0.4, moving_camera=0.5), samples=1)()
    again = PairRow.from_dict(make(Task("pairs", 5)).rows[0])
    np.testing.assert_array_equal(again.curr.color, rows[5].curr.color)
    np.testing.assert_array_equal(again.curr.depth, rows[5].curr.depth)


def test_unknown_splits_are_refused() -> None:
    with pytest.raises(DatasetError, match="split"):
        ClutterScenes(0, "holdout")


def test_sequences_have_actions_one_after_another_with_rests_between() -> None:
    frames = 12
    make = ClutterScenes(0, "val", SMALL, sequence_frames=frames)()
    made = next(rows for rows in (make(Task("sequences", scene)).rows for scene in range(4)) if rows)
    sequence = [SequenceRow.from_dict(row) for row in made]
    assert len(sequence) == frames
    assert [row.frame for row in sequence] == [STEP * number for number in range(frames)]
    poses = [{item.label: item.pose for item in row.objects} for row in sequence]
    moved = [
        {
            label
            for label in before.keys() & after.keys()
            if np.linalg.norm(before[label][:3, 3] - after[label][:3, 3]) > 0.003
        }
        for before, after in itertools.pairwise(poses)
    ]
    assert not moved[0]  # the first action starts at frame `FIRST_START`
    assert any(moved)
