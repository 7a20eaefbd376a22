"""Depth noise measured from pairs whose noise is known."""

from __future__ import annotations

import numpy as np
import pytest

import analytic
from objectflow import geometry
from objectflow.alignment.frame_pair import FramePair
from objectflow.alignment.measured_noise import MeasuredNoiseSettings, measure_depth_noise
from objectflow.frame import RgbdFrame
from objectflow.geometry.camera import Camera
from objectflow.geometry.depth_noise import STRUCTURED_LIGHT, DepthNoise, MeasuredDepthNoise
from objectflow.typing import Float32Array, Float64Array

CAMERA = Camera(320, 240, 300.0, 300.0, 159.5, 119.5)
FLOOR = DepthNoise(base=1e-6, growth=0.0)
"""A lower bound that no measurement reaches."""
CAMERA_MOTION = geometry.se3_exp([0.03, -0.02, 0.02, 0.03, -0.05, 0.02])


def noisy_pair(depth: Float32Array, sigma: Float32Array, *, color_noise: float = 0.0) -> FramePair:
    """Two frames of one textured surface, each with its own Gaussian noise of depth and colour."""
    rng = np.random.default_rng(0)
    base = rng.integers(40, 200, (240, 320, 3)).astype(np.float64)
    frames = []
    for _ in range(2):
        color = np.clip(np.rint(base + color_noise * rng.standard_normal(base.shape)), 0, 255).astype(np.uint8)
        measured = depth + sigma * rng.standard_normal(depth.shape).astype(np.float32)
        frames.append(RgbdFrame(color, measured.astype(np.float32), CAMERA))
    return FramePair(*frames)


def measured(
    pair: FramePair, prev_T_curr: Float64Array | None = None, settings: MeasuredNoiseSettings | None = None
) -> MeasuredDepthNoise:
    found = measure_depth_noise(pair, prev_T_curr, floor=FLOOR, settings=settings or MeasuredNoiseSettings())
    assert isinstance(found, MeasuredDepthNoise)
    return found


STRIP = np.broadcast_to(np.arange(320) // 80, (240, 320))
"""(H, W) int: four strips of equal width."""


def test_noise_of_surfaces_at_four_depths() -> None:
    """Strips at four depths, of which each lies in a bin of its own; their noise follows no common formula."""
    depths, sigmas = np.array([0.5, 0.9, 1.5, 2.5]), np.array([0.002, 0.003, 0.012, 0.02])
    found = measured(noisy_pair(depths[STRIP].astype(np.float32), sigmas[STRIP].astype(np.float32), color_noise=1.0))
    np.testing.assert_allclose(found.depths, depths, rtol=0.01)
    np.testing.assert_allclose(found.sigmas, sigmas, rtol=0.05)
    np.testing.assert_allclose(found.sigma(depths), sigmas, rtol=0.05)


def test_a_bin_noisier_than_a_farther_one_takes_the_noise_of_the_farther_one() -> None:
    """The noise of real cameras grows with depth, so the excess of the near strip is no noise."""
    depths, sigmas = np.array([0.5, 0.9, 1.5, 2.5]), np.array([0.02, 0.003, 0.012, 0.02])
    found = measured(noisy_pair(depths[STRIP].astype(np.float32), sigmas[STRIP].astype(np.float32)))
    np.testing.assert_allclose(found.sigma(depths), [0.003, 0.003, 0.012, 0.02], rtol=0.05)


def test_a_near_object_without_texture_that_moves_in_depth_is_not_noise() -> None:
    """A plain box at 0.6 m, alone in its bin, approaches by 3 cm: its colour stays, and its depth changes alike."""
    depth, sigma = np.full((240, 320), 1.0, np.float32), np.full((240, 320), 0.004, np.float32)
    depth[80:160, 100:200] = 0.6
    pair = noisy_pair(depth, sigma)
    curr = pair.curr.frame.depth.copy()
    curr[80:160, 100:200] -= 0.03
    found = measured(FramePair(pair.prev, RgbdFrame(pair.curr.frame.color, curr, CAMERA)))
    assert found.depths[0] == pytest.approx(0.57, abs=0.001)
    np.testing.assert_allclose(found.sigma([0.57, 1.0]), 0.004, rtol=0.05)


def test_noise_that_grows_with_depth() -> None:
    """A ramp from 0.5 to 3 m with the noise of a stereo camera: within 10% at every depth."""
    depth = np.broadcast_to(np.geomspace(0.5, 3.0, 320), (240, 320)).astype(np.float32)
    sigma = (0.001 + 0.004 * depth**2).astype(np.float32)
    found = measured(noisy_pair(depth, sigma))
    z = np.linspace(0.6, 2.6, 20)
    np.testing.assert_allclose(found.sigma(z), 0.001 + 0.004 * z**2, rtol=0.1)


@pytest.mark.parametrize("camera_motion", [None, CAMERA_MOTION], ids=["static", "moving"])
@pytest.mark.parametrize("seed", [3, 5, 8])
def test_noise_before_a_static_and_a_moving_camera(seed: int, camera_motion: Float64Array | None) -> None:
    scene = analytic.make_scene(seed, camera_motion=camera_motion, depth_noise=0.006)
    found = measured(FramePair(scene.prev, scene.curr), camera_motion)
    depths = np.array(found.depths)
    assert len(depths) >= 3
    np.testing.assert_allclose(found.sigmas, 0.006 * depths**2, rtol=0.1)


def test_the_motion_of_the_camera_is_needed() -> None:
    """Taken as static, the slope of the table would count as noise."""
    scene = analytic.make_scene(5, camera_motion=CAMERA_MOTION, depth_noise=0.001)
    pair = FramePair(scene.prev, scene.curr)
    right, wrong = measured(pair, CAMERA_MOTION), measured(pair)
    z = 0.8
    assert right.sigma(z) == pytest.approx(0.001 * z**2, rel=0.2)
    assert wrong.sigma(z) > 3 * right.sigma(z)


@pytest.mark.parametrize(("seed", "objects", "tolerance"), [(51, 2, 0.08), (53, 3, 0.08), (57, 6, 0.25)])
def test_moving_objects_hardly_inflate_it(seed: int, objects: int, tolerance: float) -> None:
    """A crowded table has bins of depth that hold little but moving objects."""
    scene = analytic.make_scene(seed, objects=(objects, objects), depth_noise=0.003)
    assert scene.moving
    found = measured(FramePair(scene.prev, scene.curr))
    assert len(found.depths) >= 3
    np.testing.assert_allclose(found.sigmas, 0.003 * np.array(found.depths) ** 2, rtol=tolerance)


def test_a_plain_object_that_moves_does_not_inflate_it() -> None:
    """Its colour is unchanged where it overlaps itself or the table, but its depth changes by more than noise does."""
    depth, sigma = np.full((240, 320), 1.0, np.float32), np.full((240, 320), 0.004, np.float32)
    plain = measured(noisy_pair(depth, sigma))
    pair = noisy_pair(depth, sigma)
    curr = pair.curr.frame.depth.copy()
    curr[80:160, 100:200] -= 0.2
    lifted = FramePair(pair.prev, RgbdFrame(pair.curr.frame.color, curr, CAMERA))
    assert measured(lifted).sigma(1.0) == pytest.approx(float(plain.sigma(1.0)), rel=0.03)


def test_heavy_tails_count() -> None:
    """A fifth of the pixels with ten times the noise: the 90th percentile exceeds the estimate of the median."""
    rng = np.random.default_rng(1)
    depth = np.full((240, 320), 1.0, np.float32)
    sigma = np.where(rng.random((240, 320)) < 0.2, 0.02, 0.002).astype(np.float32)
    found = float(measured(noisy_pair(depth, sigma)).sigma(1.0))
    # The 90th percentile of |a - b| for this mixture, drawn independently; 1.645 and the root of 2 as documented.
    wide = np.where(rng.random(10**6) < 0.2, 0.02, 0.002)
    expected = np.quantile(np.abs(rng.standard_normal(10**6) * wide * np.sqrt(2)), 0.9) / 1.645 / np.sqrt(2)
    assert found == pytest.approx(expected, rel=0.1)
    assert found > 2 * 0.002


def test_too_few_pixels_give_the_floor() -> None:
    rng = np.random.default_rng(0)
    depth = np.full((240, 320), 1.0, np.float32)
    pair = noisy_pair(depth, np.full_like(depth, 0.01))
    other = rng.integers(0, 255, (240, 320, 3), dtype=np.uint8)
    changed = FramePair(pair.prev, RgbdFrame(other, pair.curr.frame.depth, CAMERA))
    holes = np.zeros_like(depth)
    holes[0, :10] = 1.0
    empty = FramePair(pair.prev, RgbdFrame(pair.curr.frame.color, holes, CAMERA))
    for bad in (empty, FramePair(pair.curr, pair.curr).at_width(16)):
        assert measure_depth_noise(bad) is STRUCTURED_LIGHT
    few = MeasuredNoiseSettings(min_pixels=200, max_color_change=0.5)
    assert measure_depth_noise(changed, floor=FLOOR, settings=few) is FLOOR
    away = geometry.make_transform(geometry.so3_exp([0.0, np.pi, 0.0]), [0.0, 0.0, 0.0])
    assert measure_depth_noise(pair, away) is STRUCTURED_LIGHT
    # Enough pixels together, but not in any bin.
    ramp = np.broadcast_to(np.geomspace(0.5, 3.0, 320), (240, 320)).astype(np.float32)
    sparse = MeasuredNoiseSettings(min_pixels=60_000)
    assert measure_depth_noise(noisy_pair(ramp, 0 * ramp), floor=FLOOR, settings=sparse) is FLOOR


def test_the_floor_is_a_lower_bound() -> None:
    """Two equal frames have no noise at all."""
    depth = np.full((240, 320), 1.0, np.float32)
    pair = noisy_pair(depth, 0 * depth)
    found = measure_depth_noise(pair)
    z = np.linspace(0.3, 4, 30)
    np.testing.assert_array_equal(found.sigma(z), STRUCTURED_LIGHT.sigma(z))


def test_wide_frames_are_compared_at_the_width_of_the_settings() -> None:
    scene = analytic.make_scene(5, width=640, height=480, depth_noise=0.006)
    pair = FramePair(scene.prev, scene.curr)
    for width in (320, 160):
        found = measured(pair, settings=MeasuredNoiseSettings(width=width))
        np.testing.assert_allclose(found.sigmas, 0.006 * np.array(found.depths) ** 2, rtol=0.1)
