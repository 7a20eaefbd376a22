"""Rows of tabletop scenes: consistent, true in depth, of all kinds, reproducible."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from objectflow import geometry
from objectflow.dataset.check import contradictions
from objectflow.dataset.moving_objects import moving_labels
from objectflow.dataset.schema import PairRow
from objectflow.dataset.warp_check import warp_errors
from objectflow.errors import DatasetError
from objectflow.synth.generation.tabletop_maker import TabletopScenes
from objectflow.synth.generation.tasks import Task
from objectflow.synth.scenes.tabletop_scene import SCENE, TabletopSettings

pytest.importorskip("mujoco_warp", reason="generating needs the extra [synth]")

SMALL = TabletopSettings(
    replace(SCENE, objects=(1, 5), width=160, height=120, focal=(215.0, 310.0)), motionless=0.4, moving_camera=0.5
)


@pytest.fixture(scope="module")
def rows() -> list[PairRow]:
    make = TabletopScenes(0, "val", SMALL, samples=1, views=2)()
    return [PairRow.from_dict(row) for scene in range(10) for row in make(Task("pairs", scene)).rows]


def test_rows_are_consistent_and_of_all_kinds(rows: list[PairRow]) -> None:
    assert [contradictions(row) for row in rows] == [[]] * len(rows)
    movers = [len(moving_labels(row)) for row in rows]
    cameras = [not np.array_equal(row.camera_motion, np.eye(4)) for row in rows]
    assert 0 in movers
    assert max(movers) > 1
    assert set(cameras) == {False, True}
    categories = {obj.category for row in rows for obj in row.objects}
    assert {"package", "arm"} <= categories
    assert "shadow-caster" not in categories  # casters are never in sight
    medians = [np.median(row.curr.depth[row.curr.depth > 0]) for row in rows]
    assert min(medians) < 0.6
    assert max(medians) > 1.2


def test_pixels_move_by_the_motions_of_the_row_including_the_background(rows: list[PairRow]) -> None:
    for row in rows:
        assert row.camera_motion is not None
        scale = float(np.median(row.curr.depth[row.curr.depth > 0]))
        errors = warp_errors(row, raw=True)
        assert np.median(np.abs(errors.depth)) < 0.001 * max(1.0, scale)
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
            assert np.median(difference) < 0.012 * max(1.0, scale)


def test_without_motion_depth_and_labels_are_equal_though_colours_are_not(rows: list[PairRow]) -> None:
    static = [row for row in rows if np.array_equal(row.camera_motion, np.eye(4)) and not moving_labels(row)]
    assert static
    for row in static:
        np.testing.assert_array_equal(row.prev.depth, row.curr.depth)
        np.testing.assert_array_equal(row.prev_labels, row.curr_labels)
    assert any(np.abs(row.prev.color.astype(int) - row.curr.color).mean() > 2 for row in static)


def test_views_of_a_scene_share_its_objects(rows: list[PairRow]) -> None:
    assert [row.key for row in rows[:3]] == ["val-000000-0", "val-000000-1", "val-000001-0"]
    for one, other in zip(rows[::2], rows[1::2], strict=True):
        assert one.scene == other.scene
        names = [{obj.label: obj.model for obj in row.objects} for row in (one, other)]
        shared = set(names[0]) & set(names[1])
        assert all(names[0][label] == names[1][label] for label in shared)


def test_the_same_seed_gives_the_same_row(rows: list[PairRow]) -> None:
    again = PairRow.from_dict(TabletopScenes(0, "val", SMALL, samples=1, views=2)()(Task("pairs", 5)).rows[1])
    np.testing.assert_array_equal(again.prev.color, rows[11].prev.color)
    np.testing.assert_array_equal(again.curr.depth, rows[11].curr.depth)


def test_sequences_are_refused() -> None:
    with pytest.raises(DatasetError, match="sequences"):
        TabletopScenes(0, "val", SMALL)()(Task("sequences", 0))
