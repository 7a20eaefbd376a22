"""Noise models of depth cameras: the formula by hand, and measured standard deviations between and beyond depths."""

from __future__ import annotations

import typing

import numpy as np
import pytest

from objectflow.errors import SettingsError
from objectflow.geometry.camera import Camera
from objectflow.geometry.depth_noise import (
    DEPTH_NOISE,
    STRUCTURED_LIGHT,
    DepthNoise,
    DepthNoiseName,
    MeasuredDepthNoise,
)

CAMERA = Camera(128, 96, 100.0, 100.0, 63.5, 47.5)


def test_the_default_is_what_nguyen_et_al_measured() -> None:
    """Equation 2 of the paper."""
    sigma = STRUCTURED_LIGHT.sigma(np.array([0.2, 0.4, 2.4]))
    np.testing.assert_allclose(sigma, [0.0012, 0.0012, 0.0088], atol=1e-6)
    assert STRUCTURED_LIGHT.sigma(2.3) == pytest.approx(0.0012 + 0.0019 * 1.9**2, rel=1e-5)
    assert sigma.dtype == np.float32


def test_the_formula() -> None:
    noise = DepthNoise(base=0.002, growth=0.006, near=0.2)
    z = np.array([[0.0, 0.1, 0.2], [0.7, 1.2, 3.2]])
    expected = [[0.002, 0.002, 0.002], [0.002 + 0.006 * 0.25, 0.002 + 0.006, 0.002 + 0.006 * 9]]
    np.testing.assert_allclose(noise.sigma(z), expected, rtol=1e-5)


def test_a_match_has_the_noise_of_two_depths_and_of_its_pixel() -> None:
    expected = np.hypot(np.sqrt(2) * 0.0012, 0.5 * 0.4 / 100)
    np.testing.assert_allclose(STRUCTURED_LIGHT.match_sigma(np.array([0.4]), CAMERA, pixels=0.5), expected, rtol=1e-5)
    far = np.sqrt(2 * (0.002 + 0.006 * 1.8**2) ** 2 + (0.7 * 2.0 / 100) ** 2)
    np.testing.assert_allclose(DEPTH_NOISE["stereo"].match_sigma(np.array([2.0]), CAMERA), far, rtol=1e-5)


@pytest.mark.filterwarnings("error")
def test_absurd_depth_has_an_infinite_error() -> None:
    assert STRUCTURED_LIGHT.sigma(np.float32(1e30)) == np.inf
    assert STRUCTURED_LIGHT.match_sigma(np.array([1e30]), CAMERA)[0] == np.inf


def test_the_named_models() -> None:
    """Every name but "measured" has a formula; time of flight is near the cited values, stereo by triangulation."""
    assert set(DEPTH_NOISE) | {"measured"} == set(typing.get_args(DepthNoiseName))
    assert DEPTH_NOISE["structured-light"] is STRUCTURED_LIGHT
    assert DEPTH_NOISE["time-of-flight"].sigma(0.5) == pytest.approx(0.002, abs=2e-4)
    assert DEPTH_NOISE["time-of-flight"].sigma(3.5) == pytest.approx(0.009, abs=1e-3)
    assert DEPTH_NOISE["stereo"].sigma(1.0) == pytest.approx(1.0**2 * 0.2 / (640 * 0.05), rel=0.1)


MEASURED = MeasuredDepthNoise(0.001, 0.0, 0.4, depths=(0.5, 1.0, 2.0), sigmas=(0.002, 0.004, 0.012))


@pytest.mark.parametrize(
    ("z", "sigma"),
    [(0.5, 0.002), (0.75, 0.003), (1.0, 0.004), (1.25, 0.006), (2.0, 0.012), (0.1, 0.002), (9.0, 0.012)],
)
def test_measured_noise_is_interpolated_and_constant_beyond_its_depths(z: float, sigma: float) -> None:
    assert MEASURED.sigma(z) == pytest.approx(sigma, rel=1e-5)


def test_the_formula_is_a_lower_bound_of_measured_noise() -> None:
    z = np.linspace(0.2, 6, 200)
    low = MeasuredDepthNoise(depths=(0.5, 3.0), sigmas=(0.0001, 0.1))
    measured = np.clip(0.0001 + (z - 0.5) * (0.1 - 0.0001) / 2.5, 0.0001, 0.1)
    np.testing.assert_allclose(low.sigma(z), np.maximum(STRUCTURED_LIGHT.sigma(z), measured), rtol=1e-4)
    nothing = MeasuredDepthNoise()
    np.testing.assert_array_equal(nothing.sigma(z), STRUCTURED_LIGHT.sigma(z))


def test_measured_noise_of_matches() -> None:
    expected = np.hypot(np.sqrt(2) * 0.003, 0.7 * 0.75 / 100)
    assert MEASURED.match_sigma(np.array([0.75]), CAMERA)[0] == pytest.approx(expected, rel=1e-5)


def test_unknown_depth_has_unknown_noise() -> None:
    for noise in (STRUCTURED_LIGHT, MEASURED):
        assert np.isnan(noise.sigma(np.array([np.nan, 1.0]))).tolist() == [True, False]


@pytest.mark.parametrize("bad", [{"base": 0.0}, {"base": -1.0}, {"growth": -0.1}, {"near": float("nan")}])
def test_values_out_of_bounds_are_rejected(bad: dict[str, float]) -> None:
    with pytest.raises(SettingsError, match=f"setting {next(iter(bad))} must be"):
        DepthNoise(**bad)


def test_models_are_equal_by_their_numbers() -> None:
    structured = DepthNoise(base=0.0012, growth=0.0019, near=0.4)
    measured = MeasuredDepthNoise(depths=(1.0,), sigmas=(0.1,))
    assert structured == STRUCTURED_LIGHT
    assert structured != MeasuredDepthNoise()
    assert measured == MeasuredDepthNoise(depths=[1], sigmas=["0.1"])  # type: ignore[arg-type, list-item]
    assert measured != MeasuredDepthNoise(depths=(1.0,), sigmas=(0.2,))
