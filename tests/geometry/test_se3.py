"""Rigid motions and projection against SciPy, matrix exponentials and closed forms."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from objectflow import Camera, geometry
from objectflow.errors import GeometryError
from objectflow.typing import Float64Array

CAMERA = Camera(width=32, height=24, fx=40.0, fy=42.0, cx=15.0, cy=12.5)
ANGLES = [0.0, 1e-300, 1e-16, 1e-12, 1e-8, 9e-5, 1.1e-4, 9e-3, 1.1e-2, 0.5, 2.0, np.pi - 1e-4, np.pi - 1e-9, np.pi]
AXES = np.concatenate([np.eye(3), -np.eye(3), Rotation.random(6, rng=np.random.default_rng(0)).as_matrix()[:, 0]])

reproducible = settings(derandomize=True, deadline=None, max_examples=60, database=None)
lengths = st.floats(-3, 3, allow_subnormal=False)
vectors = st.tuples(lengths, lengths, lengths).map(np.array)
seeds = st.integers(0, 2**32 - 1)


def twist_matrix(twist: Float64Array) -> Float64Array:
    out = np.zeros((4, 4))
    out[:3, 3] = twist[:3]
    out[:3, :3] = np.cross(np.eye(3), twist[3:])  # row i is e_i x w, which is row i of hat(w)
    return out


def random_motion(rng: np.random.Generator) -> Float64Array:
    out = np.eye(4)
    out[:3, :3] = Rotation.random(rng=rng).as_matrix()
    out[:3, 3] = rng.normal(size=3)
    return out


def test_hat_is_the_cross_product() -> None:
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(2, 5, 3))
    np.testing.assert_allclose((geometry.hat(a) @ b[..., None])[..., 0], np.cross(a, b), atol=1e-15)


@pytest.mark.parametrize("angle", ANGLES)
def test_so3_exp_agrees_with_scipy(angle: float) -> None:
    expected = Rotation.from_rotvec(angle * AXES).as_matrix()
    np.testing.assert_allclose(geometry.so3_exp(angle * AXES), expected, atol=5e-15)


@pytest.mark.parametrize("angle", ANGLES)
def test_so3_log_recovers_the_vector(angle: float) -> None:
    found = geometry.so3_log(Rotation.from_rotvec(angle * AXES).as_matrix())
    if angle == np.pi:  # both directions of the axis are the same rotation
        found = found * np.sign((found * AXES).sum(-1, keepdims=True))
    np.testing.assert_allclose(found, angle * AXES, atol=1e-14)


def test_so3_log_keeps_the_digits_of_tiny_angles() -> None:
    w = 1e-9 * AXES
    np.testing.assert_allclose(geometry.so3_log(geometry.so3_exp(w)), w, rtol=1e-6, atol=1e-24)


def test_half_turns_about_the_axes_are_exact() -> None:
    for axis in range(3):
        R = -np.eye(3)
        R[axis, axis] = 1
        np.testing.assert_allclose(np.abs(geometry.so3_log(R)), np.pi * np.eye(3)[axis], atol=1e-15)


@reproducible
@given(vectors)
def test_so3_exp_gives_rotations_with_the_shortest_log(w: Float64Array) -> None:
    R = geometry.so3_exp(w)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-14)
    assert np.linalg.det(R) > 0
    found = geometry.so3_log(R)
    assert np.linalg.norm(found) <= np.pi + 1e-12
    np.testing.assert_allclose(
        Rotation.from_rotvec(found).as_matrix(), Rotation.from_rotvec(w).as_matrix(), atol=1e-13
    )
    assert geometry.rotation_angle(R) == pytest.approx(Rotation.from_rotvec(w).magnitude(), abs=1e-12)


def test_quaternions_agree_with_scipy_in_every_branch() -> None:
    rotations = Rotation.from_rotvec(np.concatenate([a * AXES for a in (0.1, 1.5, 3.1)]))
    found = geometry.quaternion_from_matrix(rotations.as_matrix())
    np.testing.assert_allclose(found, rotations.as_quat(canonical=True, scalar_first=True), atol=1e-15)


@pytest.mark.parametrize("angle", ANGLES)
def test_se3_exp_agrees_with_the_matrix_exponential(angle: float) -> None:
    rho = np.random.default_rng(1).normal(size=(len(AXES), 3))
    twists = np.concatenate([rho, angle * AXES], axis=-1)
    expected = np.stack([expm(twist_matrix(twist)) for twist in twists])
    np.testing.assert_allclose(geometry.se3_exp(twists), expected, rtol=1e-13, atol=1e-13)


@pytest.mark.parametrize("angle", ANGLES)
def test_se3_log_inverts_se3_exp(angle: float) -> None:
    rho = np.random.default_rng(2).normal(size=(len(AXES), 3))
    T = geometry.se3_exp(np.concatenate([rho, angle * AXES], axis=-1))
    np.testing.assert_allclose(geometry.se3_exp(geometry.se3_log(T)), T, atol=1e-13)


@reproducible
@given(vectors, vectors)
def test_se3_exp_is_a_rigid_motion_with_an_inverse(rho: Float64Array, w: Float64Array) -> None:
    T = geometry.se3_exp(np.concatenate([rho, w]))
    points = np.random.default_rng(3).normal(size=(4, 3))
    moved = geometry.transform(T, points)
    np.testing.assert_allclose(np.diff(moved, axis=0) @ T[:3, :3], np.diff(points, axis=0), atol=1e-13)
    np.testing.assert_allclose(geometry.transform(geometry.inverse(T), moved), points, atol=1e-13)
    np.testing.assert_allclose(geometry.inverse(T), np.linalg.inv(T), atol=1e-13)


def test_transform_keeps_the_dtype_and_accepts_batches() -> None:
    T = random_motion(np.random.default_rng(4))
    points = np.random.default_rng(5).normal(size=(3, 2, 3)).astype(np.float32)
    moved = geometry.transform(T, points)
    assert moved.dtype == np.float32
    homogeneous = np.concatenate([points, np.ones((3, 2, 1))], axis=-1)
    np.testing.assert_allclose(moved, np.einsum("ij,abj->abi", T, homogeneous)[..., :3], atol=1e-5)
    np.testing.assert_array_equal(geometry.make_transform(T[:3, :3], T[:3, 3]), T)


@reproducible
@given(seeds, st.integers(3, 30))
def test_kabsch_recovers_a_motion(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    T, points = random_motion(rng), rng.normal(size=(count, 3))
    found, determined = geometry.kabsch(points, geometry.transform(T, points), rng.uniform(0.1, 2, count))
    if not determined:  # three nearly collinear points
        assert count == 3
        return
    np.testing.assert_allclose(found, T, atol=1e-6)


def test_kabsch_agrees_with_scipy_on_noisy_weighted_points() -> None:
    rng = np.random.default_rng(6)
    points, weights = rng.normal(size=(40, 3)), rng.uniform(0, 3, 40)
    T = random_motion(rng)
    seen = geometry.transform(T, points) + rng.normal(0, 0.05, (40, 3))
    found, _ = geometry.kabsch(points, seen, weights)
    p_mean, q_mean = np.average(points, axis=0, weights=weights), np.average(seen, axis=0, weights=weights)
    expected = Rotation.align_vectors(seen - q_mean, points - p_mean, weights=weights)[0].as_matrix()
    np.testing.assert_allclose(found[:3, :3], expected, atol=1e-9)
    np.testing.assert_allclose(found[:3, 3], q_mean - expected @ p_mean, atol=1e-9)


def test_kabsch_treats_integer_weights_as_repetitions() -> None:
    rng = np.random.default_rng(7)
    points, seen = rng.normal(size=(2, 6, 3))
    counts = np.array([1, 2, 0, 3, 1, 0])
    weighted, _ = geometry.kabsch(points, seen, counts)
    repeated, _ = geometry.kabsch(np.repeat(points, counts, axis=0), np.repeat(seen, counts, axis=0))
    np.testing.assert_allclose(weighted, repeated, atol=1e-12)


def test_kabsch_never_reflects() -> None:
    rng = np.random.default_rng(8)
    points = rng.normal(size=(20, 3))
    found, determined = geometry.kabsch(points, points * [1, 1, -1])
    assert determined
    np.testing.assert_allclose(found[:3, :3] @ found[:3, :3].T, np.eye(3), atol=1e-13)
    assert np.linalg.det(found[:3, :3]) == pytest.approx(1)
    # None of many random rotations has a lower cost.
    cost = np.sum((geometry.transform(found, points) - points * [1, 1, -1]) ** 2)
    for R in Rotation.random(300, rng=rng).as_matrix():
        moved = (points - points.mean(0)) @ R.T + (points * [1, 1, -1]).mean(0)
        assert np.sum((moved - points * [1, 1, -1]) ** 2) >= cost - 1e-9


def test_kabsch_fits_points_on_a_plane() -> None:
    rng = np.random.default_rng(9)
    points, T = rng.normal(size=(10, 3)) * [1, 1, 0], random_motion(rng)
    found, determined = geometry.kabsch(points, geometry.transform(T, points))
    assert determined
    np.testing.assert_allclose(found, T, atol=1e-12)


@pytest.mark.parametrize(
    ("points", "weights"),
    [
        (np.zeros((0, 3)), None),
        (np.ones((1, 3)), None),
        (np.array([[0.0, 0, 1], [1, 0, 1]]), None),
        (np.outer(np.linspace(0, 1, 9), [1.0, 2, 3]) + 1, None),
        (np.ones((5, 3)), None),
        (np.random.default_rng(0).normal(size=(5, 3)), np.zeros(5)),
        (np.random.default_rng(0).normal(size=(5, 3)), np.array([1.0, 1, 0, 0, 0])),
    ],
    ids=["none", "one", "two", "line", "coincident", "no weight", "two that count"],
)
def test_kabsch_reports_points_that_determine_no_rotation(points: Float64Array, weights: Float64Array | None) -> None:
    T = random_motion(np.random.default_rng(10))
    seen = geometry.transform(T, points)
    found, determined = geometry.kabsch(points, seen, weights)
    assert not determined
    np.testing.assert_allclose(found[:3, :3] @ found[:3, :3].T, np.eye(3), atol=1e-12)
    counting = np.ones(len(points), bool) if weights is None else weights > 0
    np.testing.assert_allclose(geometry.transform(found, points[counting]), seen[counting], atol=1e-12)


def test_kabsch_of_a_batch_equals_kabsch_of_its_elements() -> None:
    rng = np.random.default_rng(11)
    points, seen = rng.normal(size=(2, 2, 3, 7, 3))
    points[1, 2] = 0.5  # one degenerate set in the batch
    weights = rng.uniform(0, 1, (2, 3, 7))
    found, determined = geometry.kabsch(points, seen, weights)
    assert found.shape == (2, 3, 4, 4)
    assert determined.tolist() == [[True] * 3, [True, True, False]]
    for i, j in ((0, 0), (0, 2), (1, 1)):
        np.testing.assert_allclose(found[i, j], geometry.kabsch(points[i, j], seen[i, j], weights[i, j])[0], atol=1e-9)


GOOD = np.random.default_rng(0).normal(size=(4, 3))


@pytest.mark.parametrize(
    ("curr", "prev", "weights", "message"),
    [
        (GOOD, GOOD[:3], None, "one shape"),
        (GOOD[:, :2], GOOD[:, :2], None, r"\(\.\.\., N, 3\)"),
        (GOOD[0], GOOD[0], None, r"\(\.\.\., N, 3\)"),
        (GOOD, GOOD, np.ones(3), "weights"),
        (GOOD, GOOD, np.array([1, 1, 1, -1.0]), "weights"),
        (GOOD, GOOD, np.array([1, 1, 1, np.nan]), "weights"),
        (np.full((4, 3), np.nan), GOOD, None, "finite points"),
        (GOOD, np.full((4, 3), np.inf), None, "finite points"),
    ],
)
def test_kabsch_refuses_bad_input(
    curr: Float64Array, prev: Float64Array, weights: Float64Array | None, message: str
) -> None:
    with pytest.raises(GeometryError, match=message):
        geometry.kabsch(curr, prev, weights)


def test_back_projection_and_projection_of_known_points() -> None:
    depth = np.zeros((24, 32), np.float32)
    depth[12, 15] = 2.0
    depth[3, 31] = 0.5
    points = geometry.back_project(depth, CAMERA)
    assert points.dtype == np.float32
    np.testing.assert_allclose(points[12, 15], [0, -0.5 / 42 * 2, 2], atol=1e-7)
    np.testing.assert_allclose(points[3, 31], [16 / 40 * 0.5, -9.5 / 42 * 0.5, 0.5], atol=1e-7)
    assert np.isnan(points).all(-1).sum() == depth.size - 2
    np.testing.assert_allclose(geometry.project(points[3, 31], CAMERA), [31, 3], atol=1e-4)


@reproducible
@given(seeds)
def test_projection_inverts_back_projection(seed: int) -> None:
    depth = np.random.default_rng(seed).uniform(0.1, 5, (24, 32)).astype(np.float32)
    pixels = geometry.project(geometry.back_project(depth, CAMERA), CAMERA)
    v, u = np.mgrid[0:24, 0:32]
    np.testing.assert_allclose(pixels, np.stack([u, v], axis=-1), atol=1e-4)


def test_projection_agrees_with_the_intrinsic_matrix_and_is_nan_behind_the_camera() -> None:
    points = np.random.default_rng(12).uniform([-1, -1, 0.2], [1, 1, 3], (50, 3))
    rays = points @ CAMERA.matrix.T
    np.testing.assert_allclose(geometry.project(points, CAMERA), rays[:, :2] / rays[:, 2:], atol=1e-12)
    behind: NDArray[Any] = np.array([[0.1, 0.1, 0], [0.1, 0.1, -1], [np.nan, 0, 1]])
    assert np.isnan(geometry.project(behind, CAMERA)[:, 0]).all()


def test_back_projection_of_pixels_is_that_of_the_image() -> None:
    depth = np.random.default_rng(15).uniform(0.1, 5, (24, 32)).astype(np.float32)
    v, u = np.mgrid[0:24, 0:32]
    points = geometry.back_project_pixels(np.stack([u, v], axis=-1).astype(np.float32), depth, CAMERA)
    assert points.dtype == np.float32
    np.testing.assert_array_equal(points, geometry.back_project(depth, CAMERA))
    between = geometry.back_project_pixels(np.array([15.5, 12.0]), np.float64(2), CAMERA)
    np.testing.assert_allclose(geometry.project(between, CAMERA), [15.5, 12], atol=1e-12)


def test_nearest_rotation_maximises_the_trace_and_never_reflects() -> None:
    rng = np.random.default_rng(16)
    matrices = rng.normal(size=(8, 3, 3))
    found, singular = geometry.nearest_rotation(matrices)
    np.testing.assert_allclose(np.linalg.det(found), 1, atol=1e-12)
    np.testing.assert_allclose(singular, np.linalg.svd(matrices, compute_uv=False), atol=1e-12)
    trials = Rotation.random(300, rng=rng).as_matrix()
    for R, matrix in zip(found, matrices, strict=True):
        assert np.trace(R.T @ matrix) >= np.einsum("kij,ij->k", trials, matrix).max() - 1e-9
    for R in trials[:5]:
        np.testing.assert_allclose(geometry.nearest_rotation(3 * R)[0], R, atol=1e-12)


def test_flow_follows_equation_1() -> None:
    rng = np.random.default_rng(13)
    depth = rng.uniform(0.5, 1, (24, 32)).astype(np.float32)
    depth[:, 5] = 0
    points = geometry.back_project(depth, CAMERA)
    labels = np.zeros((24, 32), np.int32)
    labels[:8], labels[8:12] = 1, 2
    motions = {1: random_motion(rng), 2: random_motion(rng)}
    flow = geometry.flow_from_motions(points, labels, motions)
    for label, T in motions.items():
        P = points[labels == label].astype(np.float64)
        center = np.array([0.1, -0.2, 0.7])
        shift = T[:3, :3] @ center + T[:3, 3] - center
        expected = (P - center) @ T[:3, :3].T + center + shift - P  # R (P - X) + X + T - P
        np.testing.assert_allclose(flow[labels == label], expected, atol=2e-6)
    np.testing.assert_array_equal(np.isnan(flow).all(-1), depth == 0)
    assert (flow[labels == 0][depth[labels == 0] > 0] == 0).all()


def test_flow_of_a_moving_background_and_of_labels_without_a_motion() -> None:
    rng = np.random.default_rng(14)
    points = geometry.back_project(rng.uniform(0.5, 1, (24, 32)).astype(np.float32), CAMERA)
    labels = np.zeros((24, 32), np.int32)
    labels[:8], labels[8:12] = 1, 2
    background, T = random_motion(rng), random_motion(rng)
    flow = geometry.flow_from_motions(points, labels, {1: T}, background)
    expected = geometry.transform(background, points.astype(np.float64)) - points
    np.testing.assert_allclose(flow[8:], expected[8:], atol=2e-6)
    np.testing.assert_allclose(flow[:8], geometry.transform(T, points[:8].astype(np.float64)) - points[:8], atol=2e-6)


def test_small_motions_stay_exact_in_float32() -> None:
    points = geometry.back_project(np.full((24, 32), 3, np.float32), CAMERA)
    T = geometry.make_transform(np.eye(3), [1e-7, 0, 0])
    flow = geometry.flow_from_motions(points, np.ones((24, 32), np.int32), {1: T})
    np.testing.assert_allclose(flow[..., 0], 1e-7, rtol=1e-6)
