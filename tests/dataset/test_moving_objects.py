"""Rows with a camera motion: static objects are background, and moving objects are distinguished from them."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from helpers.pair_sets import write_part
from helpers.small_sets import make_frame
from objectflow import geometry
from objectflow.dataset.batches import Batches
from objectflow.dataset.moving_objects import has_moved, keep_labels, moving_labels, without_static
from objectflow.dataset.pairing import pair_of_frames
from objectflow.dataset.schema import PairRow
from objectflow.dataset.shards import open_pairs
from objectflow.evaluation.data.truth import truth_of_row

STATIC = np.eye(4)


def pair() -> PairRow:
    """Object 1 moves by 6 cm, object 2 is static."""
    return pair_of_frames(make_frame("a", 20), make_frame("a", 80))


def rotation_by(degrees: float, shift: float = 0.0) -> np.ndarray:
    return geometry.make_transform(geometry.so3_exp(np.radians([0, degrees, 0])), [shift, 0, 0])


def test_objects_move_from_two_millimetres_or_half_a_degree_relative_to_the_world() -> None:
    assert not has_moved(STATIC, STATIC, STATIC)
    assert [has_moved(rotation_by(0, shift), STATIC, STATIC) for shift in (0.0019, 0.0021)] == [False, True]
    assert [has_moved(rotation_by(angle), STATIC, STATIC) for angle in (0.49, 0.51)] == [False, True]
    camera, pose = rotation_by(4, 0.03), rotation_by(-20, 0.4)
    assert not has_moved(camera @ pose, pose, camera)
    assert has_moved(pose, pose, camera)  # an object at rest relative to a moving camera moves in the world


def test_without_a_camera_motion_no_object_is_background() -> None:
    row = pair()
    assert moving_labels(row) == {1, 2}
    assert len(without_static(row.to_dict())) == 2
    truth = truth_of_row(row)
    assert {obj.label for obj in truth.objects} == {1, 2}
    assert truth.moving == {1}


@pytest.mark.parametrize("camera", [STATIC, rotation_by(2, 0.01)])
def test_with_a_camera_motion_static_objects_are_background(camera: np.ndarray) -> None:
    row = pair()
    first, second = row.objects
    second = dataclasses.replace(second, prev_pose=camera @ second.curr_pose)
    row = dataclasses.replace(row, objects=(first, second), camera_motion=camera)
    assert moving_labels(row) == {1}
    assert [entry["label"] for entry in without_static(row.to_dict())] == [1]
    truth = truth_of_row(row)
    assert truth.moving == {1}
    assert set(np.unique(truth.labels)) == {0, 1}
    assert (truth.background_prev_T_curr is None) == np.array_equal(camera, STATIC)
    # The flow of the static object is that of the world.
    points = geometry.back_project(row.curr.depth, row.curr.camera)
    world = geometry.transform(camera, points[35, 50].astype(np.float64)) - points[35, 50]
    np.testing.assert_allclose(truth.scene_flow[35, 50], world, atol=1e-6)


def test_the_camera_motion_survives_parquet_and_other_rows_have_no_such_column(tmp_path: Path) -> None:
    camera = rotation_by(2, 0.01)
    row = dataclasses.replace(pair(), camera_motion=camera)
    with_motion = open_pairs(write_part(tmp_path / "clutter", "pairs", [row.to_dict()], "test"), "test")
    np.testing.assert_array_equal(with_motion[0].camera_motion, camera)
    without = open_pairs(write_part(tmp_path / "paper", "pairs", [pair().to_dict()], "test"), "test")
    assert without[0].camera_motion is None
    assert "camera_motion" not in without.raw(0)[0]


def test_batches_exclude_static_objects(tmp_path: Path) -> None:
    row = dataclasses.replace(pair(), camera_motion=STATIC)
    folder = write_part(tmp_path / "clutter", "pairs", [row.to_dict()], "test")
    batch = next(Batches(open_pairs(folder, "test"), 1, size=None, seed=0).iterate())
    assert batch.table.label.tolist() == [[1]]
    assert np.unique(batch.curr_labels.numpy()).tolist() == np.unique(batch.prev_labels.numpy()).tolist() == [0, 1]
    assert batch.camera_motion is not None
    assert batch.camera_motion.tolist() == [STATIC.tolist()]


def test_other_labels_become_background() -> None:
    labels = np.array([[0, 1, 2], [3, 2, 1]], np.uint8)
    assert keep_labels(labels, {2, 3}).tolist() == [[0, 0, 2], [3, 2, 0]]
    assert keep_labels(labels, set()).dtype == np.uint8
