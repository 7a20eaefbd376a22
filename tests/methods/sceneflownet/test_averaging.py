"""+Rig: averages of predictions per object, against plain means and scipy's mean of rotations."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from objectflow import geometry
from objectflow.errors import GeometryError
from objectflow.methods.sceneflownet.averaging import average_motions, mean_rotation


def test_averages_of_noisy_pixels() -> None:
    rng = np.random.default_rng(0)
    labels = rng.choice(np.array([0, 2, 5], np.int32), size=(24, 30))
    rotation, translation, center = rng.normal(scale=0.3, size=(3, 24, 30, 3)).astype(np.float32)
    confidence = rng.random((24, 30)).astype(np.float32)
    objects = average_motions(labels, rotation, translation, center, confidence=confidence)
    assert [obj.id for obj in objects] == [2, 5]
    for obj in objects:
        mask = labels == obj.id
        R = Rotation.from_rotvec(rotation[mask].astype(np.float64)).mean().as_matrix()
        np.testing.assert_allclose(obj.prev_T_curr[:3, :3], R, atol=1e-9)
        np.testing.assert_allclose(obj.center, center[mask].mean(axis=0, dtype=np.float64), atol=1e-9)
        np.testing.assert_allclose(obj.translation, translation[mask].mean(axis=0, dtype=np.float64), atol=1e-9)
        assert obj.pixels == mask.sum()
        assert obj.score == pytest.approx(confidence[mask].mean(), abs=1e-6)


def test_rotations_near_180_degrees_do_not_cancel() -> None:
    # A rotation by nearly pi, predicted on both sides of the wrap: the mean of the axis-angle vectors would be near 0.
    axis = np.array([0.6, 0.0, 0.8])
    rotation = np.empty((6, 10, 3))
    rotation[:3], rotation[3:] = axis * (np.pi - 0.02), -axis * (np.pi - 0.02)
    zeros, labels = np.zeros((6, 10, 3)), np.ones((6, 10), np.int32)
    (obj,) = average_motions(labels, rotation, zeros, zeros, confidence=np.ones((6, 10)))
    np.testing.assert_allclose(obj.prev_T_curr[:3, :3], geometry.so3_exp(axis * np.pi), atol=1e-9)


def test_the_flow_of_the_averages_is_exact_for_exact_predictions() -> None:
    rng = np.random.default_rng(1)
    labels = np.zeros((8, 9), np.int32)
    labels[2:5, 1:4], labels[5:, 5:] = 1, 2
    points = rng.normal(size=(8, 9, 3)).astype(np.float32)
    Q, T, X = rng.normal(scale=0.4, size=(3, 3, 3))
    motions = average_motions(labels, Q[labels], T[labels], X[labels], confidence=np.ones((8, 9)))
    flow = geometry.flow_from_motions(points, labels, {obj.id: obj.prev_T_curr for obj in motions})
    for k in (1, 2):
        P = points[labels == k]
        expected = (P - X[k]) @ Rotation.from_rotvec(Q[k]).as_matrix().T + X[k] + T[k] - P  # equation 1
        np.testing.assert_allclose(flow[labels == k], expected, atol=1e-5)
    assert not flow[labels == 0].any()


def test_an_object_moves_by_translation_or_by_rotation() -> None:
    labels = np.arange(1, 5, dtype=np.int32)[None].repeat(3, axis=0)
    shift, turn = np.zeros((3, 4, 3)), np.zeros((3, 4, 3))
    shift[:, 1, 0], turn[:, 2, 1], shift[:, 3, 0] = 0.005, 0.2, 0.003
    objects = average_motions(labels, turn, shift, np.zeros((3, 4, 3)), confidence=np.ones((3, 4)), still=0.004)
    assert [obj.moving for obj in objects] == [False, True, True, False]


def test_the_mean_is_a_rotation_even_where_rotations_cancel() -> None:
    rng = np.random.default_rng(2)
    for matrix in (np.zeros((3, 3)), np.diag([1.0, -1.0, 0.0]), -np.eye(3), rng.normal(size=(3, 3))):
        R = mean_rotation(matrix)
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(R) == pytest.approx(1)


def test_the_mean_is_the_nearest_rotation() -> None:
    rng = np.random.default_rng(3)
    matrices = geometry.so3_exp(rng.normal(size=(50, 3)))
    best = mean_rotation(matrices.mean(axis=0))

    def cost(R: np.ndarray) -> float:
        return float(((matrices - R) ** 2).sum())

    others = geometry.so3_exp(rng.normal(scale=0.05, size=(200, 3))) @ best
    assert all(cost(best) < cost(other) for other in others)


def test_no_objects() -> None:
    zeros = np.zeros((3, 4, 3))
    assert average_motions(np.zeros((3, 4), np.int32), zeros, zeros, zeros, confidence=np.ones((3, 4))) == ()


def test_invalid_maps_are_rejected() -> None:
    labels, zeros, ones = np.ones((3, 4), np.int32), np.zeros((3, 4, 3)), np.ones((3, 4))
    with pytest.raises(GeometryError, match="maps"):
        average_motions(labels, zeros[1:], zeros, zeros, confidence=ones)
    holes = zeros.copy()
    holes[1, 1] = np.nan
    with pytest.raises(GeometryError, match="finite"):
        average_motions(labels, zeros, zeros, holes, confidence=ones)
    labels[1, 1] = 0
    assert len(average_motions(labels, zeros, zeros, holes, confidence=ones)) == 1
