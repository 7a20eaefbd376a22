"""Compensating a moving camera, against scenes rendered from both of its places."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import analytic
from objectflow import geometry
from objectflow.alignment.frame_pair import FramePair
from objectflow.errors import FrameError, MethodError
from objectflow.frame import RgbdFrame
from objectflow.geometry.camera import Camera
from objectflow.methods import moving_camera
from objectflow.methods.baselines.dense_flow import DenseFlow
from objectflow.motion import ObjectMotion, SceneMotion
from objectflow.typing import Float64Array


def camera_motion(degrees: tuple[float, float, float], centimetres: tuple[float, float, float]) -> Float64Array:
    out = np.eye(4)
    out[:3, :3] = Rotation.from_euler("xyz", degrees, degrees=True).as_matrix()
    out[:3, 3] = np.array(centimetres) / 100
    return out


MOTION = camera_motion((2, -3, 1.5), (3, -2, 2))


class Truth:
    """An estimator for a still camera that knows the answer, and says which frame it was shown."""

    def __init__(self, pair: analytic.AnalyticPair) -> None:
        self.pair, self.shown = pair, pair.prev

    def __call__(self, prev: RgbdFrame, curr: RgbdFrame) -> SceneMotion:
        self.shown = prev
        objects = [
            ObjectMotion(k, int((self.pair.labels == k).sum()), 1.0, k in self.pair.moving, self.pair.centers[k], T)
            for k, T in self.pair.prev_T_curr.items()
        ]
        return SceneMotion(self.pair.labels, self.pair.scene_flow, tuple(objects), method="truth")


@pytest.mark.parametrize("seed", [3, 5])
def test_the_previous_frame_looks_as_if_taken_from_the_current_place(seed: int) -> None:
    still, moved = analytic.make_scene(seed), analytic.make_scene(seed, camera_motion=MOTION)
    seen = moving_camera.as_seen_from(moved.prev, MOTION, moved.curr.camera)
    assert seen is not None
    valid = seen.depth > 0
    assert valid.mean() > 0.9
    off = np.abs(seen.depth - still.prev.depth)[valid]
    assert np.median(off) < 1e-4
    assert np.mean(off > 0.002) < 0.01
    color = np.abs(seen.color.astype(int) - still.prev.color)[valid]
    assert np.median(color) <= 1


def test_no_motion_gives_the_frame_back() -> None:
    frame = analytic.make_scene(4).prev
    seen = moving_camera.as_seen_from(frame, np.eye(4), frame.camera)
    assert seen is not None
    np.testing.assert_allclose(seen.depth, frame.depth, atol=1e-6)
    assert np.abs(seen.color.astype(int) - frame.color).max() <= 1


def test_cracks_close_and_a_nearer_camera_keeps_its_surfaces_whole() -> None:
    # Half as far away every pixel covers four: without closing, three of four pixels would be holes.
    camera = Camera(64, 48, 60.0, 60.0, 31.5, 23.5)
    frame = RgbdFrame(np.full((48, 64, 3), 90, np.uint8), np.full((48, 64), 1.0, np.float32), camera)
    nearer = camera_motion((0, 0, 0), (0, 0, 50))
    seen = moving_camera.as_seen_from(frame, nearer, camera)
    assert seen is not None
    np.testing.assert_allclose(seen.depth[2:-2, 2:-2], 0.5, atol=1e-6)


def test_motions_are_carried_back_to_the_moving_camera() -> None:
    still, moved = analytic.make_scene(5), analytic.make_scene(5, camera_motion=MOTION)
    motion = moving_camera.compose(Truth(still)(still.prev, still.curr), moved.curr, MOTION)
    np.testing.assert_allclose(motion.scene_flow, moved.scene_flow, atol=1e-5)
    for obj in motion.objects:
        np.testing.assert_allclose(obj.prev_T_curr, moved.prev_T_curr[obj.id], atol=1e-9)
    assert motion.camera_motion is not None
    np.testing.assert_allclose(motion.camera_motion, MOTION)


@pytest.mark.parametrize(
    ("camera_cm", "object_cm", "moving"), [(40, 1, False), (40, 10, True), (2, 1, True), (0, 1, True)]
)
def test_what_the_camera_s_own_way_may_feign_is_no_mover(camera_cm: float, object_cm: float, moving: bool) -> None:
    """A depth camera's scale is off by some percent: 1 cm is nothing beside 40, and much beside 2."""
    pair = analytic.make_scene(5)
    shift = geometry.make_transform(np.eye(3), [object_cm / 100, 0.0, 0.0])
    obj = ObjectMotion(1, 100, 0.9, True, np.array([0.1, 0.0, 1.0]), shift)
    still = SceneMotion(np.ones_like(pair.labels), np.zeros_like(pair.scene_flow), (obj,))
    way = camera_motion((0, 0, 0), (camera_cm, 0, 0))
    (found,) = moving_camera.compose(still, pair.curr, way).objects
    assert found.moving is moving
    np.testing.assert_allclose(found.prev_T_curr, way @ shift)


def test_the_method_sees_a_still_camera_and_the_result_a_moving_one() -> None:
    still, moved = analytic.make_scene(5), analytic.make_scene(5, camera_motion=MOTION)
    truth = Truth(still)
    motion = moving_camera.MovingCamera(truth)(moved.prev, moved.curr)
    assert np.median(np.abs(truth.shown.depth - still.prev.depth)[truth.shown.depth > 0]) < 1e-3
    assert motion.camera_motion is not None
    error = geometry.inverse(MOTION) @ motion.camera_motion
    assert np.linalg.norm(error[:3, 3]) < 0.002
    assert np.degrees(geometry.rotation_angle(error[:3, :3])) < 0.1
    assert np.nanmean(np.linalg.norm(motion.scene_flow - moved.scene_flow, axis=-1)) < 0.001


def test_a_still_camera_is_left_alone() -> None:
    pair = analytic.make_scene(5)
    for camera in ("static", "auto"):
        truth = Truth(pair)
        motion = moving_camera.MovingCamera(truth, camera=camera)(pair.prev, pair.curr)
        assert truth.shown is pair.prev
        assert motion.camera_motion is None


def test_what_was_made_ready_to_find_the_camera_is_handed_on() -> None:
    class Thrifty(Truth):
        def estimate(self, prev: RgbdFrame, curr: RgbdFrame, pair: FramePair) -> SceneMotion:
            self.pair = pair
            return self(prev, curr)

    pair = analytic.make_scene(5)
    thrifty = Thrifty(pair)
    motion = moving_camera.MovingCamera(thrifty)(pair.prev, pair.curr)
    assert {"matches", "target"} <= thrifty.pair.__dict__.keys()  # made, not to be made again
    assert (thrifty.pair.prev, thrifty.pair.curr) == (pair.prev, pair.curr)
    assert motion.seconds is not None
    assert motion.seconds > 0


def test_flow_of_a_moving_camera_is_better_with_compensation() -> None:
    pair = analytic.make_scene(8, camera_motion=camera_motion((-3, 2, 4), (-4, 3, 2)))
    errors = [
        np.nanmean(np.linalg.norm(method(pair.prev, pair.curr).scene_flow - pair.scene_flow, axis=-1))
        for method in (DenseFlow(), moving_camera.MovingCamera(DenseFlow(), camera="moving"))
    ]
    assert errors[1] < 0.7 * errors[0]


def test_a_camera_that_turned_right_away_leaves_only_its_own_motion(monkeypatch: pytest.MonkeyPatch) -> None:
    pair = analytic.make_scene(5)
    away = camera_motion((0, 170, 0), (0, 0, 0))
    monkeypatch.setattr(moving_camera, "find_camera_motion", lambda *_, **__: away)
    motion = moving_camera.MovingCamera(Truth(pair))(pair.prev, pair.curr)
    points = geometry.back_project(pair.curr.depth, pair.curr.camera)
    np.testing.assert_allclose(motion.scene_flow, geometry.transform(away, points) - points, atol=1e-5)
    assert motion.objects == ()


def test_bad_input() -> None:
    pair = analytic.make_scene(5)
    with pytest.raises(MethodError, match="auto, static or moving"):
        moving_camera.MovingCamera(DenseFlow(), camera="still")
    other = dataclasses.replace(pair.curr.camera, width=160, height=120)
    small = RgbdFrame(pair.curr.color[:120, :160].copy(), pair.curr.depth[:120, :160].copy(), other)
    with pytest.raises(FrameError):
        moving_camera.MovingCamera(DenseFlow())(pair.prev, small)
