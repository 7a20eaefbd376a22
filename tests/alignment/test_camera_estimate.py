"""The state of the camera: static, moving, ambiguous or unknown, and what the estimate reports."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

import analytic
from objectflow import geometry
from objectflow.alignment.camera_estimate import CameraCheckSettings, CameraEstimate, CameraMode, estimate_camera
from objectflow.alignment.camera_motion import CameraMotionSettings, dominant_motion
from objectflow.alignment.frame_pair import FramePair
from objectflow.alignment.matching import MatchSettings, PixelMatches
from objectflow.frame import RgbdFrame
from objectflow.geometry.camera import Camera
from objectflow.geometry.depth_noise import STRUCTURED_LIGHT, MeasuredDepthNoise
from objectflow.typing import Float64Array

CAMERA_MOTION = geometry.se3_exp([0.02, -0.01, 0.015, 0.01, 0.03, -0.02])


def estimate(prev: RgbdFrame, curr: RgbdFrame, camera: CameraMode = "auto") -> CameraEstimate:
    return estimate_camera(FramePair(prev, curr), camera=camera)


def test_a_static_camera() -> None:
    scene = analytic.make_scene(5)
    found = estimate(scene.prev, scene.curr)
    assert (found.state, found.prev_T_curr, found.error, found.notes) == ("static", None, 0.0, ())
    assert isinstance(found.pair.noise, MeasuredDepthNoise)


def test_a_moving_camera() -> None:
    scene = analytic.make_scene(5, camera_motion=CAMERA_MOTION, depth_noise=0.002)
    found = estimate(scene.prev, scene.curr)
    assert found.state == "moving"
    assert found.prev_T_curr is not None
    off = geometry.inverse(CAMERA_MOTION) @ found.prev_T_curr
    assert np.linalg.norm(off[:3, 3]) < 0.003
    assert np.degrees(geometry.rotation_angle(off[:3, :3])) < 0.2
    assert 0 < found.error < 0.01
    assert found.notes == ()


@pytest.mark.parametrize("camera", ["auto", "moving"])
def test_the_camera_between_two_rooms_is_unknown(camera: CameraMode) -> None:
    first, second = analytic.make_scene(5), analytic.make_scene(8)
    found = estimate(first.prev, second.curr, camera)
    assert found.state == "unknown"
    assert found.prev_T_curr is None
    (note,) = found.notes
    assert note.startswith("camera: unknown: no motion of the camera explains most of the image")


def test_a_static_camera_is_taken_as_true() -> None:
    first, second = analytic.make_scene(5), analytic.make_scene(8)
    assert estimate(first.prev, second.curr, "static").state == "static"


def board_before_a_wall(shift: int) -> RgbdFrame:
    """A board at 0.6 m that covers 70% of the image and moved by some pixels, before a wall at 1.2 m."""
    rng = np.random.default_rng(3)
    textures = rng.integers(0, 25, (2, 60, 100, 3)) * 10
    wall, board = (np.kron(image.astype(np.uint8), np.ones((4, 4, 1), np.uint8)) for image in textures)
    color, depth = wall[:240, :320].copy(), np.full((240, 320), 1.2, np.float32)
    left, right = 40 + shift, 264 + shift
    color[:, left:right] = board[:240, : right - left]
    depth[:, left:right] = 0.6
    return RgbdFrame(color, depth, Camera(320, 240, 300.0, 300.0, 159.5, 119.5))


def test_a_board_that_fills_most_of_the_image_is_ambiguous() -> None:
    """The board stands still before a moving camera, or the wall before a static one: the frames allow both."""
    frames = board_before_a_wall(0), board_before_a_wall(12)
    found = estimate(*frames)
    assert found.state == "moving"
    assert found.ambiguous
    assert found.notes[0].startswith("camera: ambiguous: a large part of the image stands still")
    assert not estimate(*frames, "static").ambiguous


def test_features_find_a_camera_that_moved_too_far_for_optical_flow() -> None:
    camera, shift = Camera(640, 480, 550.0, 550.0, 319.5, 239.5), 330
    noise = np.random.default_rng(0).integers(0, 256, (30, 60 + 10, 3)).astype(np.uint8)
    texture = cv2.resize(noise, (640 + shift, 480), interpolation=cv2.INTER_CUBIC)
    depth = np.full((480, 640), 1.1, np.float32)
    prev, curr = (
        RgbdFrame(np.ascontiguousarray(texture[:, start : start + 640]), depth, camera) for start in (shift, 0)
    )
    by_flow = FramePair(prev, curr, matching=MatchSettings(sufficient_flow_share=0.0))
    assert by_flow.flow.share < 0.3
    found = estimate_camera(by_flow)
    assert found.state == "moving"
    assert found.prev_T_curr is not None
    np.testing.assert_allclose(found.prev_T_curr[:3, 3], [-shift * 1.1 / 550, 0, 0], atol=0.01)


@pytest.mark.parametrize(("min_rival_ratio", "state"), [(0.0, "static"), (0.5, "unknown")])
def test_a_camera_whose_motion_the_matches_show_is_not_static(min_rival_ratio: float, state: str) -> None:
    """The settings stand for an image that supports no motion, such as one whose other frame is blurred."""
    scene = analytic.make_scene(5, camera_motion=CAMERA_MOTION)
    settings = CameraCheckSettings(
        min_gain=100, min_inlier_ratio=0, min_supported_ratio=0, min_visible=0, min_rival_ratio=min_rival_ratio
    )
    assert estimate_camera(FramePair(scene.prev, scene.curr), settings=settings).state == state
    still = analytic.make_scene(5)
    assert estimate_camera(FramePair(still.prev, still.curr), settings=settings).state == "static"


def matches_with_outliers(share: float, motion: Float64Array) -> PixelMatches:
    """Matches of which a share follows a motion and the others are random."""
    rng, count = np.random.default_rng(0), 2000
    camera = Camera(640, 480, 600.0, 600.0, 319.5, 239.5)
    curr = np.stack([rng.uniform(-0.5, 0.5, count), rng.uniform(-0.4, 0.4, count), rng.uniform(0.8, 1.4, count)], -1)
    prev = geometry.transform(motion, curr)
    wrong = rng.random(count) >= share
    prev[wrong] = prev[wrong] + rng.uniform(-0.3, 0.3, (int(wrong.sum()), 3))
    return PixelMatches(
        geometry.project(curr, camera).astype(np.float32), curr.astype(np.float32), prev.astype(np.float32)
    )


@pytest.mark.parametrize("seed", range(4))
def test_three_matches_are_drawn_often_enough_for_15_percent_of_inliers(seed: int) -> None:
    """250 sets miss with probability 0.43; the number of sets adapts to the share of inliers."""
    camera = Camera(640, 480, 600.0, 600.0, 319.5, 239.5)
    matches = matches_with_outliers(0.15, CAMERA_MOTION)
    found = dominant_motion(
        matches, camera, rng=np.random.default_rng(seed), noise=STRUCTURED_LIGHT, settings=CameraMotionSettings()
    )
    assert found is not None
    off = geometry.inverse(CAMERA_MOTION) @ found[0]
    assert np.linalg.norm(off[:3, 3]) < 0.003
    assert np.degrees(geometry.rotation_angle(off[:3, :3])) < 0.2
