"""The cost of a motion per pixel, by closed forms on walls at known depths."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from objectflow import geometry
from objectflow.alignment.appearance import AppearanceFeatures
from objectflow.alignment.likelihood import LikelihoodSettings, motion_cost
from objectflow.frame import RgbdFrame
from objectflow.geometry.camera import Camera
from objectflow.geometry.depth_noise import DepthNoise
from objectflow.typing import Float64Array

CAMERA = Camera(width=80, height=60, fx=80.0, fy=80.0, cx=39.5, cy=29.5)
NOISE = DepthNoise(base=0.009 / 1.4, growth=0.0)
"""With the default settings, a standard deviation of 1 cm at any depth."""
DEFAULTS = LikelihoodSettings()


def wall(depth: float = 1.0, grey: int = 120) -> RgbdFrame:
    return RgbdFrame(np.full((60, 80, 3), grey, np.uint8), np.full((60, 80), depth, np.float32), CAMERA)


def shift(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Float64Array:
    return geometry.make_transform(np.eye(3), [x, y, z])


def cost_at_center(
    prev: RgbdFrame, motion: Float64Array, settings: LikelihoodSettings = DEFAULTS, noise: DepthNoise = NOISE
) -> tuple[float, bool]:
    """Cost of the middle of a wall at 1 m, by depth alone, and whether it would have been hidden."""
    points = geometry.back_project(wall().depth, CAMERA)
    cost, hidden = motion_cost(prev, points, motion, None, noise=noise, settings=settings)
    assert cost.shape == hidden.shape == (60, 80)
    assert cost.dtype == np.float32
    return float(cost[30, 40]), bool(hidden[30, 40])


@pytest.mark.parametrize(
    ("z", "cost", "hidden"),
    [
        (0.0, 0.0, False),
        (0.01, 0.5, False),
        (-0.02, 2.0, False),
        (-0.029, 0.5 * 2.9**2, False),
        (-0.031, 6.0, False),  # in front of the wall: a free-space violation
        (0.019, 0.5 * 1.9**2, False),
        (0.021, 3.0, True),  # just behind the wall
        (0.059, 3.0, True),
        (0.061, 2.0, True),  # far behind it
        (3.0, 2.0, True),
    ],
)
def test_cost_of_depth_in_standard_deviations(z: float, cost: float, hidden: bool) -> None:
    assert cost_at_center(wall(), shift(z=z)) == (pytest.approx(cost, abs=1e-3), hidden)


def test_the_noise_model_and_its_settings_set_the_scale() -> None:
    for noise, settings in (
        (DepthNoise(base=0.019 / 1.4, growth=0.0), DEFAULTS),
        (NOISE, LikelihoodSettings(noise_factor=1.4 * 19 / 9)),
        (NOISE, LikelihoodSettings(extra_noise=0.011)),
    ):
        assert cost_at_center(wall(), shift(z=0.02), settings, noise)[0] == pytest.approx(0.5, abs=1e-3)


def test_the_costs_are_settings() -> None:
    settings = LikelihoodSettings(free_space_violation=9.0, hidden=4.0, unseen=0.25, hidden_sigmas=1.0)
    assert cost_at_center(wall(), shift(z=-0.1), settings)[0] == 9.0
    assert cost_at_center(wall(), shift(z=0.1), settings) == (4.0, True)
    assert cost_at_center(wall(), shift(z=0.015), settings) == (5.0, True)
    assert cost_at_center(wall(), shift(x=5.0), settings) == (0.25, False)


@pytest.mark.parametrize(("out_of_view", "expected"), [(None, 1.0), (3.5, 3.5)])
def test_points_without_a_measurement(out_of_view: float | None, expected: float) -> None:
    """Outside the image, behind the camera, on a hole of the previous frame, and without depth in the current one."""
    points = geometry.back_project(wall().depth, CAMERA)
    hole = wall()
    hole = dataclasses.replace(hole, depth=np.where(np.arange(80) > 40, hole.depth, 0).astype(np.float32))
    for prev, motion in ((wall(), shift(x=-3.0)), (wall(), shift(z=-2.0)), (hole, shift(x=-0.1))):
        cost, hidden = motion_cost(prev, points, motion, None, out_of_view=out_of_view, noise=NOISE)
        assert cost[30, 40] == expected
        assert not hidden[30, 40]
    points[30, 40] = np.nan
    cost, hidden = motion_cost(wall(), points, np.eye(4), None, out_of_view=out_of_view, noise=NOISE)
    assert cost[30, 40] == expected
    assert not hidden[30, 40]
    behind, _ = motion_cost(wall(), points, shift(z=0.2), None, out_of_view=out_of_view, noise=NOISE)
    assert behind[10, 10] == (DEFAULTS.hidden if out_of_view is None else out_of_view)


def test_the_best_of_four_pixels_counts_at_an_edge() -> None:
    """Half a pixel beside an edge, both the near and the far surface fit."""
    depth = np.where(np.arange(80) < 40, 1.0, 1.5) * np.ones((60, 1))
    prev = RgbdFrame(wall().color, depth.astype(np.float32), CAMERA)
    points = geometry.back_project(wall().depth, CAMERA)
    for motion in (shift(x=-0.5 / 80), shift(x=-0.5 / 80 * 1.5, z=0.5)):
        cost, _ = motion_cost(prev, points, motion, None, noise=NOISE)
        assert cost[30, 40] == pytest.approx(0, abs=1e-4)


def test_a_box_gives_the_same_costs_as_the_whole_image() -> None:
    rng = np.random.default_rng(0)
    colors = rng.integers(0, 255, (2, 60, 80, 3), dtype=np.uint8)
    depths = rng.uniform(0.9, 1.1, (2, 60, 80)).astype(np.float32)
    prev, curr = (RgbdFrame(color, depth, CAMERA) for color, depth in zip(colors, depths, strict=True))
    appearance = AppearanceFeatures(prev.color), AppearanceFeatures(curr.color)
    points = geometry.back_project(curr.depth, CAMERA)
    motion = geometry.se3_exp([0.01, -0.02, 0.01, 0.02, 0.01, -0.03])
    whole, whole_hidden = motion_cost(prev, points, motion, appearance, noise=NOISE)
    box = slice(10, 33), slice(5, 70)
    part, part_hidden = motion_cost(prev, points, motion, appearance, box, noise=NOISE)
    np.testing.assert_array_equal(part, whole[box])
    np.testing.assert_array_equal(part_hidden, whole_hidden[box])
    assert 0 <= whole.min() < whole.max() == DEFAULTS.free_space_violation


def test_colour_costs_up_to_its_maximum_and_lightness_little() -> None:
    points = geometry.back_project(wall().depth, CAMERA)

    def cost(prev: tuple[int, int, int], curr: tuple[int, int, int], settings: LikelihoodSettings = DEFAULTS) -> float:
        features = tuple(AppearanceFeatures(np.full((60, 80, 3), color, np.uint8)) for color in (prev, curr))
        found, _ = motion_cost(wall(), points, np.eye(4), (features[0], features[1]), noise=NOISE, settings=settings)
        return float(found[30, 40])

    assert cost((90, 90, 90), (90, 90, 90)) == pytest.approx(0, abs=1e-5)
    assert cost((200, 30, 30), (30, 30, 200)) == DEFAULTS.max_color
    assert cost((200, 30, 30), (30, 30, 200), LikelihoodSettings(max_color=1.25)) == 1.25
    # OpenCV's 8-bit lightness of grey 128 and 160 is 137 and 168; a difference of 40 costs 0.5.
    assert cost((128, 128, 128), (160, 160, 160)) == pytest.approx(0.5 * (31 / 40) ** 2, rel=0.05)
    strict = LikelihoodSettings(lightness_tolerance=20.0)
    assert cost((128, 128, 128), (160, 160, 160), strict) == pytest.approx(0.5 * (31 / 20) ** 2, rel=0.05)
