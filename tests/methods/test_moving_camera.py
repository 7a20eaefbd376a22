"""Compensation of a moving camera, against scenes rendered from both camera poses."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import analytic
from objectflow import geometry
from objectflow.alignment.camera_estimate import CameraEstimate
from objectflow.alignment.camera_motion import CameraMotionSettings
from objectflow.alignment.frame_pair import FramePair
from objectflow.errors import FrameError, MethodError, SettingsError
from objectflow.frame import RgbdFrame
from objectflow.geometry.camera import Camera
from objectflow.geometry.depth_noise import DEPTH_NOISE, STRUCTURED_LIGHT, MeasuredDepthNoise
from objectflow.methods import moving_camera
from objectflow.methods.base import PairEstimator
from objectflow.methods.baselines.dense_flow import DenseFlow
from objectflow.methods.moving_camera import MovingCamera
from objectflow.motion import ObjectMotion, SceneMotion
from objectflow.typing import Float64Array


def camera_motion(degrees: tuple[float, float, float], centimetres: tuple[float, float, float]) -> Float64Array:
    out = np.eye(4)
    out[:3, :3] = Rotation.from_euler("xyz", degrees, degrees=True).as_matrix()
    out[:3, 3] = np.array(centimetres) / 100
    return out


MOTION = camera_motion((2, -3, 1.5), (3, -2, 2))


def truth_of(scene: analytic.AnalyticPair) -> SceneMotion:
    objects = [
        ObjectMotion(k, int((scene.labels == k).sum()), 1.0, k in scene.moving, scene.centers[k], T)
        for k, T in scene.prev_T_curr.items()
    ]
    return SceneMotion(scene.labels, scene.scene_flow, tuple(objects), method="truth")


class Truth:
    """An estimator for a static camera that returns the truth and records the previous frame that it is given."""

    def __init__(self, scene: analytic.AnalyticPair) -> None:
        self.scene, self.prev = scene, scene.prev

    def __call__(self, prev: RgbdFrame, curr: RgbdFrame) -> SceneMotion:
        self.prev = prev
        return truth_of(self.scene)


class PreparedTruth(PairEstimator):
    """The same for prepared pairs, which it records."""

    def __init__(self, scene: analytic.AnalyticPair) -> None:
        self.scene, self.pairs = scene, list[FramePair]()

    def estimate(self, pair: FramePair) -> SceneMotion:
        self.pairs.append(pair)
        return truth_of(self.scene)


@pytest.mark.parametrize("seed", [3, 5])
def test_the_rendered_previous_frame_equals_that_of_a_static_camera(seed: int) -> None:
    static, moved = analytic.make_scene(seed), analytic.make_scene(seed, camera_motion=MOTION)
    seen = moving_camera.as_seen_from(moved.prev, MOTION, moved.curr.camera)
    assert seen is not None
    valid = seen.depth > 0
    assert valid.mean() > 0.9
    off = np.abs(seen.depth - static.prev.depth)[valid]
    assert np.median(off) < 1e-4
    assert np.mean(off > 0.002) < 0.01
    color = np.abs(seen.color.astype(int) - static.prev.color)[valid]
    assert np.median(color) <= 1


def test_no_motion_returns_the_frame() -> None:
    frame = analytic.make_scene(4).prev
    seen = moving_camera.as_seen_from(frame, np.eye(4), frame.camera)
    assert seen is not None
    np.testing.assert_allclose(seen.depth, frame.depth, atol=1e-6)
    assert np.abs(seen.color.astype(int) - frame.color).max() <= 1


def test_cracks_are_closed_for_a_nearer_camera() -> None:
    # At half the distance each pixel covers four: without closing, three of four pixels would be holes.
    camera = Camera(64, 48, 60.0, 60.0, 31.5, 23.5)
    frame = RgbdFrame(np.full((48, 64, 3), 90, np.uint8), np.full((48, 64), 1.0, np.float32), camera)
    nearer = camera_motion((0, 0, 0), (0, 0, 50))
    seen = moving_camera.as_seen_from(frame, nearer, camera)
    assert seen is not None
    np.testing.assert_allclose(seen.depth[2:-2, 2:-2], 0.5, atol=1e-6)


def test_motions_are_composed_with_that_of_the_camera() -> None:
    static, moved = analytic.make_scene(5), analytic.make_scene(5, camera_motion=MOTION)
    points = geometry.back_project(moved.curr.depth, moved.curr.camera)
    motion = moving_camera.compose(truth_of(static), points, MOTION)
    np.testing.assert_allclose(motion.scene_flow, moved.scene_flow, atol=1e-5)
    for obj in motion.objects:
        np.testing.assert_allclose(obj.prev_T_curr, moved.prev_T_curr[obj.id], atol=1e-9)
    assert motion.camera_motion is not None
    np.testing.assert_allclose(motion.camera_motion, MOTION)


@pytest.mark.parametrize(
    ("camera_cm", "object_cm", "moving"), [(40, 1, False), (40, 10, True), (2, 1, True), (0, 1, True)]
)
def test_an_object_must_move_by_more_than_the_error_of_the_cameras_motion(
    camera_cm: float, object_cm: float, moving: bool
) -> None:
    """The scale of a depth camera is off by a few percent: 1 cm is within the error of 40 cm, but not of 2 cm."""
    scene = analytic.make_scene(5)
    shift = geometry.make_transform(np.eye(3), [object_cm / 100, 0.0, 0.0])
    obj = ObjectMotion(1, 100, 0.9, True, np.array([0.1, 0.0, 1.0]), shift)
    static = SceneMotion(np.ones_like(scene.labels), np.zeros_like(scene.scene_flow), (obj,))
    motion = camera_motion((0, 0, 0), (camera_cm, 0, 0))
    points = geometry.back_project(scene.curr.depth, scene.curr.camera)
    (found,) = moving_camera.compose(static, points, motion).objects
    assert found.moving is moving
    np.testing.assert_allclose(found.prev_T_curr, motion @ shift)
    (exact,) = moving_camera.compose(static, points, motion, scale_error=0.0).objects
    assert exact.moving


def test_the_method_is_given_a_static_camera_and_the_result_has_a_moving_one() -> None:
    static, moved = analytic.make_scene(5), analytic.make_scene(5, camera_motion=MOTION)
    truth = Truth(static)
    motion = MovingCamera(estimator=truth)(moved.prev, moved.curr)
    assert np.median(np.abs(truth.prev.depth - static.prev.depth)[truth.prev.depth > 0]) < 1e-3
    assert motion.camera_motion is not None
    error = geometry.inverse(MOTION) @ motion.camera_motion
    assert np.linalg.norm(error[:3, 3]) < 0.002
    assert np.degrees(geometry.rotation_angle(error[:3, :3])) < 0.1
    assert np.nanmean(np.linalg.norm(motion.scene_flow - moved.scene_flow, axis=-1)) < 0.001


def test_frames_of_a_static_camera_are_passed_on() -> None:
    scene = analytic.make_scene(5)
    for camera in ("static", "auto"):
        truth = Truth(scene)
        motion = MovingCamera(estimator=truth, camera=camera)(scene.prev, scene.curr)
        assert truth.prev is scene.prev
        assert motion.camera_motion is None
        assert motion.method == "truth"


def test_a_prepared_pair_is_passed_on_with_what_was_computed_for_the_cameras_motion() -> None:
    scene = analytic.make_scene(5)
    truth, pair = PreparedTruth(scene), FramePair(scene.prev, scene.curr)
    motion = MovingCamera(estimator=truth).estimate(pair)
    (given,) = truth.pairs
    assert given.prev is pair.prev
    assert given.curr is pair.curr
    assert given.matches is pair.matches
    assert isinstance(given.noise, MeasuredDepthNoise)
    assert motion.seconds > 0
    moved = analytic.make_scene(5, camera_motion=MOTION)
    pair = FramePair(moved.prev, moved.curr)
    MovingCamera(estimator=truth).estimate(pair)
    assert truth.pairs[1].curr is pair.curr
    assert truth.pairs[1].prev.frame is not moved.prev


@pytest.mark.parametrize("motion", [None, MOTION], ids=["static", "moving"])
@pytest.mark.parametrize("name", ["structured-light", "time-of-flight", "stereo", "measured"])
def test_the_pair_has_the_noise_of_the_settings(name: str, motion: Float64Array | None) -> None:
    scene = analytic.make_scene(5, camera_motion=motion, depth_noise=0.008)
    truth = PreparedTruth(scene)
    MovingCamera(estimator=truth, depth_noise=name)(scene.prev, scene.curr)
    noise = truth.pairs[0].noise
    if name == "measured":
        assert isinstance(noise, MeasuredDepthNoise)
        assert noise.sigma(0.9) == pytest.approx(0.008 * 0.9**2, rel=0.1)
        assert noise.sigma(0.1) >= STRUCTURED_LIGHT.sigma(0.1)
    else:
        assert noise is DEPTH_NOISE[name]


def test_a_batch_is_its_pairs_one_by_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """A static camera, a moving one, another size, and a camera that turned away, in one batch."""
    static, moved = analytic.make_scene(5), analytic.make_scene(5, camera_motion=MOTION)
    small, turned = (analytic.make_scene(seed, width=160, height=120) for seed in (8, 4))
    find, away = moving_camera.estimate_camera, camera_motion((0, 170, 0), (0, 0, 0))
    monkeypatch.setattr(
        moving_camera,
        "estimate_camera",
        lambda pair, **options: (
            CameraEstimate("moving", away, pair) if pair.curr.frame is turned.curr else find(pair, **options)
        ),
    )
    scenes = [static, turned, moved, small]
    estimator = MovingCamera(estimator=DenseFlow())
    found = estimator.estimate_batch(FramePair(scene.prev, scene.curr) for scene in scenes)
    assert [motion.camera_motion is None for motion in found] == [True, False, False, True]
    for scene, motion in zip(scenes, found, strict=True):
        alone = estimator(scene.prev, scene.curr)
        np.testing.assert_array_equal(motion.scene_flow, alone.scene_flow)
        np.testing.assert_array_equal(motion.camera_motion, alone.camera_motion)
        assert motion.settings == alone.settings
    assert len({motion.seconds for motion in found}) == 1
    assert estimator.estimate_batch([]) == []


def test_the_flow_of_a_moving_camera_is_better_with_compensation() -> None:
    scene = analytic.make_scene(8, camera_motion=camera_motion((-3, 2, 4), (-4, 3, 2)))
    errors = [
        np.nanmean(np.linalg.norm(method(scene.prev, scene.curr).scene_flow - scene.scene_flow, axis=-1))
        for method in (DenseFlow(), MovingCamera(estimator=DenseFlow(), camera="moving"))
    ]
    assert errors[1] < 0.7 * errors[0]


def test_a_camera_that_turned_away_has_only_its_own_motion(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = analytic.make_scene(5)
    away = camera_motion((0, 170, 0), (0, 0, 0))
    monkeypatch.setattr(moving_camera, "estimate_camera", lambda pair, **_: CameraEstimate("moving", away, pair))
    truth = PreparedTruth(scene)
    motion = MovingCamera(estimator=truth)(scene.prev, scene.curr)
    points = geometry.back_project(scene.curr.depth, scene.curr.camera)
    np.testing.assert_allclose(motion.scene_flow, geometry.transform(away, points) - points, atol=1e-5)
    assert motion.objects == ()
    assert truth.pairs == []
    np.testing.assert_array_equal(motion.camera_motion, away)


def test_the_settings_of_the_estimator_and_of_the_compensation_are_saved_together() -> None:
    settings = CameraMotionSettings(trials=100)
    estimator = MovingCamera(estimator=DenseFlow(), camera="moving", seed=3, camera_motion=settings)
    saved = estimator.to_dict()
    assert (saved["camera"], saved["seed"], saved["camera_motion"]["trials"]) == ("moving", 3, 100)
    assert "estimator" not in saved
    scene = analytic.make_scene(5)
    assert estimator(scene.prev, scene.curr).settings == saved
    assert estimator.weights is None


def test_the_weights_are_those_of_the_estimator() -> None:
    class Learned(Truth):
        weights = Path("w.safetensors")

    assert MovingCamera(estimator=Learned(analytic.make_scene(5))).weights == Path("w.safetensors")


def test_the_closer_method_is_that_of_the_estimator() -> None:
    class Closer(PreparedTruth):
        def closer(self) -> PairEstimator:
            return DenseFlow()

    scene = analytic.make_scene(5)
    assert MovingCamera(estimator=Closer(scene), seed=3).closer() == MovingCamera(estimator=DenseFlow(), seed=3)
    plain = MovingCamera(estimator=Truth(scene))
    assert plain.closer().estimator is plain.estimator


def test_the_result_depends_on_the_seed_alone() -> None:
    scene = analytic.make_scene(5, camera_motion=MOTION, depth_noise=0.002)
    pair = FramePair(scene.prev, scene.curr)
    first, again = (MovingCamera(estimator=DenseFlow(), camera="moving", seed=1).estimate(pair) for _ in range(2))
    assert first.camera == "moving"
    np.testing.assert_array_equal(first.camera_motion, again.camera_motion)
    np.testing.assert_array_equal(first.scene_flow, again.scene_flow)


def test_invalid_input_is_rejected() -> None:
    scene = analytic.make_scene(5)
    with pytest.raises(SettingsError, match="setting camera must be one of auto, static, moving, not 'still'"):
        MovingCamera(estimator=DenseFlow(), camera="still")  # type: ignore[arg-type]
    with pytest.raises(MethodError, match=r"MovingCamera needs an estimator: MovingCamera\(estimator=\.\.\.\)"):
        MovingCamera()(scene.prev, scene.curr)
    other = dataclasses.replace(scene.curr.camera, width=160, height=120)
    small = RgbdFrame(scene.curr.color[:120, :160].copy(), scene.curr.depth[:120, :160].copy(), other)
    with pytest.raises(FrameError):
        MovingCamera(estimator=DenseFlow())(scene.prev, small)
