"""`consensus` and `rigidmatch` on real pairs beside the checkout, which are not part of the repository."""

from __future__ import annotations

import numpy as np
import pytest

import objectflow
import real_pairs
from helpers.paths import SHARED
from objectflow import geometry

DATA = SHARED / "data"

pytestmark = pytest.mark.skipif(not (DATA / "boxes_1").is_dir(), reason=f"no real pairs in {DATA}")


def estimate(
    name: str, camera: str = "auto", method: str = "consensus"
) -> tuple[objectflow.SceneMotion, real_pairs.Truth | None, np.ndarray]:
    prev, curr = real_pairs.read_pair(DATA / name)
    motion = objectflow.load(method, camera=camera)(prev, curr)
    return motion, real_pairs.read_truth(DATA / name, curr), geometry.back_project(curr.depth, curr.camera)


@pytest.mark.parametrize("name", ["boxes_1", "boxes_2"])
def test_one_box_moves_among_clutter(name: str) -> None:
    motion, truth, points = estimate(name)
    assert truth is not None
    assert len(motion.objects) == 1
    obj = motion.objects[0]
    k, iou = real_pairs.overlap(motion.labels == obj.id, truth)
    assert truth.moving[k]
    assert iou >= 0.8
    center = np.nanmedian(points[truth.labels == k], axis=0).astype(np.float64)
    true = truth.prev_T_curr[k]
    assert np.linalg.norm(geometry.transform(obj.prev_T_curr, center) - geometry.transform(true, center)) < 0.015
    assert np.degrees(geometry.rotation_angle(obj.prev_T_curr[:3, :3] @ true[:3, :3].T)) < 3


def test_nothing_moves_in_the_static_pair() -> None:
    motion, _, _ = estimate("boxes_still")
    assert motion.objects == ()
    assert motion.camera_motion is None


@pytest.mark.parametrize("name", ["bin_1", "bin_2"])
def test_carrot_and_ball_move_and_the_doll_does_not(name: str) -> None:
    motion, truth, points = estimate(name, camera="moving")
    assert truth is not None
    found = {real_pairs.overlap(motion.labels == obj.id, truth)[0]: obj for obj in motion.objects}
    assert {truth.names[k] for k in found} == {"carrot", "ball"}
    assert len(motion.objects) == 2
    for k, obj in found.items():
        seen = points[truth.labels == k]
        center = real_pairs.center_of(seen[np.isfinite(seen[:, 2])])
        error = geometry.transform(obj.prev_T_curr, center) - geometry.transform(truth.prev_T_curr[k], center)
        assert np.linalg.norm(error) < 0.006


def test_a_panning_camera_is_no_object() -> None:
    motion, _, _ = estimate("pan")
    assert motion.camera_motion is not None
    assert motion.objects == ()


@pytest.mark.parametrize(
    ("name", "movers"), [("boxes_1", 1), ("boxes_2", 1), ("boxes_still", 0), ("bin_1", 2), ("bin_2", 2)]
)
def test_rigidmatch_finds_exactly_the_moving_objects(name: str, movers: int) -> None:
    motion, truth, points = estimate(name, camera="moving" if "bin" in name else "auto", method="rigidmatch")
    found = [obj for obj in motion.objects if obj.moving]
    assert len(found) == movers
    if not movers:
        return
    assert truth is not None
    true = {real_pairs.overlap(motion.labels == obj.id, truth)[0]: obj for obj in found}
    assert set(true) == {k for k, moves in truth.moving.items() if moves}
    for k, obj in true.items():
        assert real_pairs.overlap(motion.labels == obj.id, truth)[1] >= 0.6  # an F-measure of 0.75
        seen = points[truth.labels == k]
        center = real_pairs.center_of(seen[np.isfinite(seen[:, 2])])
        error = geometry.transform(obj.prev_T_curr, center) - geometry.transform(truth.prev_T_curr[k], center)
        assert np.linalg.norm(error) < 0.015


@pytest.mark.parametrize("method", ["consensus", "rigidmatch"])
def test_the_robot_is_one_moving_region(method: str) -> None:
    motion, _, _ = estimate("robot", method=method)
    sizes = sorted(obj.pixels for obj in motion.objects)
    assert sum(sizes[:-1]) < 0.03 * sizes[-1]  # fragments beside the robot are at most 3% of it
    # The robot covers these columns of the image, from its base to its head.
    rows, columns = np.nonzero(motion.labels)
    assert np.mean((columns > 300) & (columns < 490)) > 0.97
    assert rows.min() < 60
    assert rows.max() > 430
