"""Displacements up to symmetry, against the best of many turns."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from objectflow import geometry
from objectflow.evaluation.metrics.symmetry_error import displacement_error
from objectflow.typing import Float64Array

X, Y, Z = np.eye(3)
CENTER = np.array([0.1, -0.05, 0.8])
POINTS = CENTER + np.random.default_rng(0).normal(size=(200, 3)) * [0.05, 0.03, 0.04]
TRUE = geometry.se3_exp(np.array([0.03, -0.02, 0.01, 0.3, -0.4, 0.2]))


def turned(axis: Float64Array, degrees: float) -> Float64Array:
    """The true motion after a turn about an axis through the centre."""
    R = geometry.so3_exp(np.radians(degrees) * axis)
    return TRUE @ geometry.make_transform(R, CENTER - R @ CENTER)


def plain(predicted: Float64Array) -> float:
    ends = geometry.transform(predicted, POINTS) - geometry.transform(TRUE, POINTS)
    return float(np.linalg.norm(ends, axis=1).mean())


@pytest.mark.parametrize(
    ("predicted", "axes", "orders"),
    [
        (TRUE, [], []),
        (turned(Z, 90), [Z], [4]),
        (turned(Z, 143), [Z], [0]),
        (turned(X, 180) @ geometry.inverse(TRUE) @ turned(Z, 20), [Z, X], [0, 2]),
        (turned(np.array([0.6, 0.0, 0.8]), 77), [X, Y], [0, 0]),
        (turned(X, 50), [Z, X], [0, 4]),  # a ball too
        (turned(X, 180), [X, Y, Z], [2, 2, 2]),
    ],
)
def test_turns_of_the_group_are_no_error(predicted: Float64Array, axes: list[Float64Array], orders: list[int]) -> None:
    assert displacement_error(predicted, TRUE, POINTS, CENTER, axes, orders) == pytest.approx(0, abs=1e-9)
    if axes:
        assert plain(predicted) > 0.02


def test_without_symmetry_it_is_the_plain_distance() -> None:
    predicted = turned(Y, 30) @ geometry.make_transform(np.eye(3), [0.01, 0.0, 0.0])
    assert displacement_error(predicted, TRUE, POINTS, CENTER) == pytest.approx(plain(predicted))
    shifted = geometry.make_transform(np.eye(3), [0.0, 0.02, 0.0]) @ TRUE
    assert displacement_error(shifted, TRUE, POINTS, CENTER) == pytest.approx(0.02)


@pytest.mark.parametrize("seed", range(4))
def test_a_body_of_revolution_against_fine_turns(seed: int) -> None:
    rng = np.random.default_rng(seed)
    off = geometry.make_transform(Rotation.random(random_state=seed).as_matrix(), 0.02 * rng.normal(size=3))
    predicted = TRUE @ off
    squares = [
        np.square(geometry.transform(predicted, POINTS) - geometry.transform(turned(Z, angle), POINTS)).sum(1).mean()
        for angle in np.arange(0, 360, 0.25)
    ]
    best = turned(Z, 0.25 * int(np.argmin(squares)))  # the turn of least squares
    ends = geometry.transform(predicted, POINTS) - geometry.transform(best, POINTS)
    error = displacement_error(predicted, TRUE, POINTS, CENTER, [Z], [0])
    assert error == pytest.approx(np.linalg.norm(ends, axis=1).mean(), rel=1e-3)
    assert error <= plain(predicted) + 1e-3
