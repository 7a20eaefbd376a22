"""Rows of clutter scenes: consistent, of all kinds, reproducible."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest

from objectflow import geometry
from objectflow.dataset.check import contradictions
from objectflow.dataset.moving_objects import moving_labels
from objectflow.dataset.pairing import pair_of_frames
from objectflow.dataset.schema import PairRow, SequenceRow
from objectflow.dataset.warp_check import warp_errors
from objectflow.errors import DatasetError
from objectflow.synth.generation.clutter_maker import ClutterScenes
from objectflow.synth.generation.clutter_sequences import CAMERA_PERIOD, draw_camera_path
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


def test_the_camera_of_a_sequence_moves_by_the_same_step_from_frame_to_frame_and_returns() -> None:
    path = draw_camera_path(np.random.default_rng(4), CAMERA_PERIOD + 1, turn=1.0, shift=0.005)
    steps = [geometry.inverse(before) @ after for before, after in itertools.pairwise(path)]
    np.testing.assert_allclose([np.linalg.norm(step[:3, 3]) for step in steps], 0.005, rtol=1e-6)
    turns = np.degrees([geometry.rotation_angle(step[:3, :3]) for step in steps])
    # The viewing direction turns by exactly this angle; rotation vectors add up to it only to first order.
    np.testing.assert_allclose(turns, 1.0, rtol=0.01)
    np.testing.assert_allclose(path[0], np.eye(4), atol=1e-12)
    np.testing.assert_allclose(path[-1], np.eye(4), atol=1e-12)


def test_sequences_of_a_moving_camera_show_what_rests_at_rest_in_the_world() -> None:
    make = ClutterScenes(0, "val", SMALL, sequence_frames=6, camera_turn=1.0, camera_shift=0.005)()
    made = next(rows for rows in (make(Task("sequences", scene)).rows for scene in range(4)) if rows)
    sequence = [SequenceRow.from_dict(row) for row in made]
    first, second = sequence[:2]  # the first action starts later
    assert first.world_T_camera is not None
    assert second.world_T_camera is not None
    pair = pair_of_frames(first, second)
    assert pair.camera_motion is not None
    for obj in pair.objects:
        np.testing.assert_allclose(pair.camera_motion @ obj.curr_pose, obj.prev_pose, atol=1e-3)
    # Depth agrees with the camera's motion: points of the current frame lie on the surface of the previous one.
    points = geometry.back_project(second.image.depth, second.image.camera)[second.image.valid].astype(np.float64)
    there = geometry.transform(pair.camera_motion, points)
    pixels = np.rint(geometry.project(there, first.image.camera)).astype(int)
    inside = ((pixels >= 0) & (pixels < [first.image.camera.width, first.image.camera.height])).all(axis=1)
    error = first.image.depth[pixels[inside, 1], pixels[inside, 0]] - there[inside, 2]
    assert np.median(np.abs(error)) < 0.002
