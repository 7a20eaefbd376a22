"""The camera's motion from the static background, on scenes whose camera motion is known."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

import analytic
from objectflow import geometry
from objectflow.alignment.camera_motion import CameraMotionSettings, background_motion, dominant_motion
from objectflow.alignment.frame_pair import FramePair
from objectflow.alignment.matching import PixelMatches
from objectflow.frame import RgbdFrame
from objectflow.geometry.camera import Camera
from objectflow.typing import BoolMask, Float64Array

MOTION = geometry.se3_exp([0.02, -0.015, 0.02, 0.02, -0.03, 0.025])
CAMERA = Camera(320, 240, 236.46, 236.46, 159.5, 119.5)


@cache
def pair_of(seed: int, *, moving: bool) -> tuple[analytic.AnalyticPair, FramePair]:
    scene = analytic.make_scene(seed, camera_motion=MOTION if moving else None, depth_noise=0.0015)
    return scene, FramePair(scene.prev, scene.curr)


def estimate(
    pair: FramePair,
    camera: str = "auto",
    mask: BoolMask | None = None,
    settings: CameraMotionSettings | None = None,
) -> Float64Array | None:
    settings = settings or CameraMotionSettings()
    return background_motion(pair, camera=camera, rng=np.random.default_rng(0), mask=mask, settings=settings)


def error(found: Float64Array | None, truth: Float64Array = MOTION) -> tuple[float, float]:
    """Millimetres and degrees."""
    assert found is not None
    off = geometry.inverse(truth) @ found
    return 1000 * float(np.linalg.norm(off[:3, 3])), float(np.degrees(geometry.rotation_angle(off[:3, :3])))


@pytest.mark.parametrize("camera", ["auto", "moving"])
@pytest.mark.parametrize("seed", [3, 5, 8])
def test_a_moving_camera_is_measured(seed: int, camera: str) -> None:
    millimetres, degrees = error(estimate(pair_of(seed, moving=True)[1], camera))
    assert millimetres < 2
    assert degrees < 0.15


@pytest.mark.parametrize("seed", [3, 5, 8])
def test_a_static_camera_has_exactly_no_motion(seed: int) -> None:
    pair = pair_of(seed, moving=False)[1]
    assert estimate(pair, "auto") is None
    millimetres, degrees = error(estimate(pair, "moving"), np.eye(4))
    assert millimetres < 1.5
    assert degrees < 0.1
    assert estimate(pair_of(seed, moving=True)[1], "static") is None


def test_the_settings_decide_what_counts_as_motion() -> None:
    pair = pair_of(5, moving=True)[1]
    for settings in (
        CameraMotionSettings(static_shift_px=1000.0, static_sigmas=1000.0),
        CameraMotionSettings(min_gain_ratio=1e9),
        CameraMotionSettings(min_inliers=10**6),
    ):
        assert estimate(pair, "auto", settings=settings) is None
    # Too few matches: no motion at all, rather than None, where the camera is said to move.
    none = estimate(pair, "moving", settings=CameraMotionSettings(min_inliers=10**6))
    np.testing.assert_array_equal(none, np.eye(4))


@pytest.mark.parametrize("width", [320, 160])
def test_frames_are_matched_at_the_width_of_the_settings(width: int) -> None:
    scene = analytic.make_scene(5, camera_motion=MOTION, width=480, height=360)
    pair = FramePair(scene.prev, scene.curr)
    millimetres, degrees = error(estimate(pair, settings=CameraMotionSettings(width=width)))
    assert millimetres < 3
    assert degrees < 0.2
    assert "matches" in pair.at_width(width).__dict__
    assert "matches" not in pair.__dict__


@pytest.mark.parametrize("scale", [1, 2])
def test_only_the_pixels_of_a_mask_count(scale: int) -> None:
    """The largest moving object alone has its own motion; a mask may be smaller than the image."""
    scene, pair = pair_of(8, moving=False)
    label = max(scene.moving, key=lambda k: int((scene.labels == k).sum()))
    mask = (scene.labels == label)[::scale, ::scale]
    found = estimate(pair, "moving", mask=mask)
    assert found is not None
    center, true = scene.centers[label], scene.prev_T_curr[label]
    off = geometry.transform(found, center) - geometry.transform(true, center)
    assert np.linalg.norm(off) < 0.003
    background = estimate(pair, "moving", mask=scene.labels[::scale, ::scale] == 0)
    assert error(background, np.eye(4))[0] < 1.5


def test_the_dominant_motion_is_that_of_most_matches() -> None:
    """60% of the matches follow one motion, 30% another, 10% none."""
    rng = np.random.default_rng(0)
    points = rng.uniform([-0.3, -0.2, 0.6], [0.3, 0.2, 1.0], (300, 3))
    most, other = geometry.se3_exp([0.05, 0, 0.02, 0, 0.1, 0]), geometry.se3_exp([-0.04, 0.03, 0, 0.1, 0, 0])
    prev = geometry.transform(most, points)
    prev[:90] = geometry.transform(other, points[:90])
    prev[90:120] += rng.uniform(0.1, 0.3, (30, 3))
    matches = PixelMatches(
        geometry.project(points, CAMERA).astype(np.float32), points.astype(np.float32), prev.astype(np.float32)
    )
    found = dominant_motion(matches, CAMERA, np.random.default_rng(1))
    assert found is not None
    np.testing.assert_allclose(found[0], most, atol=1e-4)
    assert found[1][120:].all()
    assert not found[1][90:120].any()
    assert dominant_motion(matches[np.arange(11)], CAMERA, np.random.default_rng(1)) is None


def test_frames_without_matches_have_no_motion() -> None:
    plain = RgbdFrame(np.full((240, 320, 3), 128, np.uint8), np.full((240, 320), 0.7, np.float32), CAMERA)
    empty = RgbdFrame(plain.color, np.where(np.arange(320) < 3, plain.depth, 0).astype(np.float32), CAMERA)
    for frame in (plain, empty):
        pair = FramePair(frame, frame)
        assert estimate(pair, "auto") is None
        found = estimate(pair, "moving")
        assert found is not None
        assert np.isfinite(found).all()
