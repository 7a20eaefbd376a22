"""Smallest boxes around points of known boxes."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from objectflow.tracking.bounding_box import smallest_box
from objectflow.typing import Float64Array


def box_points(extent: tuple[float, float, float], seed: int) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Corners and random surface points of a turned box, its rotation and its centre."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-0.5, 0.5, (500, 3))
    axis = rng.integers(0, 3, 500)
    points[np.arange(500), axis] = rng.choice([-0.5, 0.5], 500)
    corners = np.array(np.meshgrid(*[[-0.5, 0.5]] * 3)).reshape(3, -1).T
    rotation, center = Rotation.random(rng=rng).as_matrix(), rng.uniform(-1, 1, 3)
    return (np.concatenate([corners, points]) * extent) @ rotation.T + center, rotation, center


@pytest.mark.parametrize("seed", range(4))
def test_a_turned_box_is_found(seed: int) -> None:
    points, rotation, center = box_points((0.3, 0.2, 0.1), seed)
    box = smallest_box(points)
    assert box is not None
    np.testing.assert_allclose(box.extent, [0.3, 0.2, 0.1], rtol=1e-3)
    np.testing.assert_allclose(box.object_T_box[:3, 3], center, atol=1e-4)
    np.testing.assert_allclose(np.abs(box.object_T_box[:3, :3].T @ rotation), np.eye(3), atol=2e-3)
    assert np.linalg.det(box.object_T_box[:3, :3]) == pytest.approx(1)


def test_a_flat_surface_has_a_flat_box() -> None:
    points, rotation, _ = box_points((0.3, 0.2, 0.0), 5)
    box = smallest_box(points)
    assert box is not None
    np.testing.assert_allclose(box.extent, [0.3, 0.2, 0], atol=1e-3)
    assert abs(box.object_T_box[:3, 2] @ rotation[:, 2]) == pytest.approx(1, abs=1e-3)


def test_too_few_points_have_no_box() -> None:
    assert smallest_box(np.eye(3)) is None
