"""The steps of `vo-sf`, each against a simpler reference implementation."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from objectflow import Camera, RgbdFrame, geometry
from objectflow.methods.baselines.vo_sf import linearise, segment, solve, warp
from objectflow.methods.baselines.vo_sf.clusters import COUNT, Clusters, cluster
from objectflow.methods.baselines.vo_sf.pyramid import Level, build_pyramid, make_level
from objectflow.typing import Float32Array

CAMERA = Camera(320, 240, 264.0, 264.0, 159.5, 119.5)


def frame(depth: Float32Array, seed: int = 0) -> RgbdFrame:
    color = np.random.default_rng(seed).integers(0, 256, (*depth.shape, 3), dtype=np.uint8)
    return RgbdFrame(color, depth, CAMERA)


def two_walls() -> Float32Array:
    depth = np.full((240, 320), 2, np.float32)
    depth[60:180, 100:250] = 1.2
    return depth


# --- pyramid ---


def test_levels_halve_to_15x20_and_keep_the_rays() -> None:
    levels = build_pyramid(frame(np.full((240, 320), 1.5, np.float32)))
    assert [level.depth.shape for level in levels] == [(240, 320), (120, 160), (60, 80), (30, 40), (15, 20)]
    for level in levels:
        np.testing.assert_allclose(level.depth, 1.5, rtol=1e-6)
        # The image corner, half a pixel outside the first centre, lies on the same ray at every level.
        camera = level.camera
        np.testing.assert_allclose((-0.5 - camera.cx) / camera.fx, -160 / 264, rtol=1e-6)
        np.testing.assert_allclose(level.points[0, 0, 0], 1.5 * (0 - camera.cx) / camera.fx, rtol=1e-5)


def test_halving_does_not_mix_surfaces_and_fills_small_holes() -> None:
    depth = two_walls()
    depth[::8, ::8] = 0
    levels = build_pyramid(frame(depth))
    inner = levels[1].depth[1:-1, 1:-1]
    assert (inner > 0).all()
    assert np.minimum(np.abs(inner - 2), np.abs(inner - 1.2)).max() < 1e-5


def test_halving_is_the_weighted_mean_of_the_block() -> None:
    rng = np.random.default_rng(3)
    depth = (1 + 0.01 * rng.random((240, 320))).astype(np.float32)
    fine, coarse = build_pyramid(frame(depth))[:2]
    v, u = 37, 81
    block, gray = (image[2 * v - 1 : 2 * v + 3, 2 * u - 1 : 2 * u + 3] for image in (fine.depth, fine.gray))
    reference = np.sort(block[1:3, 1:3].ravel())[-2]
    weight = np.outer([1, 2, 2, 1], [1, 2, 2, 1]) * (0.1 - np.abs(block - reference))
    np.testing.assert_allclose(coarse.depth[v, u], (weight * block).sum() / weight.sum(), rtol=1e-5)
    np.testing.assert_allclose(coarse.gray[v, u], (weight * gray).sum() / weight.sum(), rtol=1e-5)


# --- clusters ---


@pytest.fixture(scope="module")
def scene() -> tuple[list[Level], Clusters]:
    depth = two_walls()
    depth[:20, :40] = 0
    depth += (np.linspace(0, 0.3, 320, dtype=np.float32)) * (depth > 0)
    levels = build_pyramid(frame(depth))
    return levels, cluster(levels)


def test_labels_are_the_nearest_centres_or_24_at_holes(scene: tuple[list[Level], Clusters]) -> None:
    levels, clusters = scene
    points = levels[0].points
    distance, nearest = cKDTree(clusters.centers).query(points.reshape(-1, 3))
    labels, soft = clusters.assign(points)
    np.testing.assert_array_equal(labels, clusters.labels(points))
    missing = points[..., 2] == 0
    assert (labels[missing] == COUNT).all()
    agree = (labels.ravel() == nearest) | missing.ravel()
    # Ties may be decided differently in single precision.
    own_distance = np.linalg.norm(
        points.reshape(-1, 3) - clusters.centers[np.minimum(labels.ravel(), COUNT - 1)], axis=1
    )
    assert (agree | (np.abs(own_distance - distance) < 1e-5)).all()
    np.testing.assert_allclose(soft.sum(-1), np.where(missing, 0, 1), atol=1e-5)


def test_k_means_has_nearly_converged(scene: tuple[list[Level], Clusters]) -> None:
    levels, clusters = scene
    points, labels = levels[1].points, clusters.labels(levels[1].points)
    means = np.stack([points[labels == k].mean(0) for k in np.flatnonzero(clusters.used)])
    assert np.abs(means - clusters.centers[clusters.used]).max() < 0.02
    assert clusters.used.sum() == COUNT


def test_soft_labels_follow_their_formula(scene: tuple[list[Level], Clusters]) -> None:
    levels, clusters = scene
    labels, soft = clusters.assign(levels[0].points)
    rng = np.random.default_rng(0)
    for v, u in zip(rng.integers(30, 240, 50), rng.integers(0, 320, 50), strict=True):
        squared = ((clusters.centers.astype(float) - levels[0].points[v, u]) ** 2).sum(1)
        exponent = 100 * (squared - squared[labels[v, u]])
        weight = np.where(clusters.connected[labels[v, u]] & (exponent < 6), np.exp(-exponent), 0)
        np.testing.assert_allclose(soft[v, u], weight / weight.sum(), atol=3e-3)


def test_clusters_are_connected_on_a_surface_and_not_across_a_gap(scene: tuple[list[Level], Clusters]) -> None:
    levels, clusters = scene
    np.testing.assert_array_equal(clusters.connected, clusters.connected.T)
    assert clusters.connected.diagonal().all()
    labels = clusters.labels(levels[0].points)
    box = np.zeros((240, 320), bool)
    box[60:180, 100:250] = True
    inside, outside = (np.setdiff1d(np.unique(labels[mask]), [COUNT]) for mask in (box, ~box))
    assert not set(inside) & set(outside)
    assert not clusters.connected[np.ix_(inside, outside)].any()
    # Each wall is one surface, so each of its clusters is connected to another.
    assert (clusters.connected[np.ix_(inside, inside)].sum(1) > 1).all()
    assert (clusters.connected[np.ix_(outside, outside)].sum(1) > 1).all()


# --- warping ---


def test_warps_by_the_identity_change_nothing() -> None:
    level = build_pyramid(frame(two_walls()))[0]
    splat = warp.splat_second(level, np.eye(4))
    inner = np.s_[:-1, :-1]
    np.testing.assert_allclose(splat.depth[inner], level.depth[inner], rtol=1e-6)
    np.testing.assert_allclose(splat.gray[inner], level.gray[inner], atol=1e-6)
    identity = np.broadcast_to(np.eye(4, dtype=np.float32)[:3], (240, 320, 3, 4))
    warped = warp.warp_second(level, level, identity)
    within = np.s_[1:-1, 1:-1]
    np.testing.assert_allclose(warped.depth[within], level.depth[within], rtol=1e-5)
    np.testing.assert_allclose(warped.gray[within], level.gray[within], atol=1e-4)


def test_a_wall_moved_by_whole_pixels_warps_onto_itself() -> None:
    wall = np.full((240, 320), 2, np.float32)
    second = build_pyramid(frame(wall))[0]
    first = Level(np.roll(second.gray, (3, 5), (0, 1)), second.points, second.camera)
    motion = np.eye(4)
    motion[:3, 3] = 5 * 2 / 264, 3 * 2 / 264, 0  # first_T_second
    for warped in (
        warp.splat_second(second, motion),
        warp.warp_second(second, first, np.tile(geometry.inverse(motion)[:3].astype(np.float32), (240, 320, 1, 1))),
    ):
        inner = np.s_[8:-8, 8:-8]
        np.testing.assert_allclose(warped.depth[inner], 2, rtol=1e-5)
        np.testing.assert_allclose(warped.gray[inner], first.gray[inner], atol=2e-3)


def test_the_backward_warp_subtracts_the_motion_in_depth() -> None:
    first = build_pyramid(frame(np.full((240, 320), 2, np.float32)))[0]
    second = build_pyramid(frame(np.full((240, 320), 2.1, np.float32)))[0]
    motion = np.tile(np.eye(4, dtype=np.float32)[:3], (240, 320, 1, 1))
    motion[..., 2, 3] = 0.1
    warped = warp.warp_second(second, first, motion)
    np.testing.assert_allclose(warped.depth[20:-20, 20:-20], 2, rtol=1e-5)


# --- constraints and their solution ---


def test_constraints_are_the_first_order_changes_of_brightness_and_depth() -> None:
    rng = np.random.default_rng(5)
    depth = (1.5 + 0.2 * rng.random((240, 320))).astype(np.float32)
    first, second = build_pyramid(frame(depth, 1))[0], build_pyramid(frame(depth[::-1].copy(), 2))[0]
    slopes = linearise.gradients(first, second)
    ones = np.ones((240, 320), np.float32)
    J, r = linearise.constraints(slopes, ones, ones)
    twist = 1e-5 * np.array([3.0, -2, 4, 1, 2, -3])
    points = slopes.middle.points.astype(np.float64)
    moved = geometry.transform(geometry.se3_exp(twist), points)
    du, dv = np.moveaxis(geometry.project(moved, CAMERA) - geometry.project(points, CAMERA), -1, 0)
    dz = moved[..., 2] - points[..., 2]
    gray = -(slopes.gray[0] * du + slopes.gray[1] * dv)
    depth_change = dz - (slopes.depth[0] * du + slopes.depth[1] * dv)
    np.testing.assert_allclose(J[..., 0, :] @ twist, 0.15 * gray, atol=2e-6)
    np.testing.assert_allclose(J[..., 1, :] @ twist, depth_change, atol=2e-6)
    np.testing.assert_allclose(r[..., 0], -0.15 * (second.gray - first.gray), atol=1e-6)
    np.testing.assert_allclose(r[..., 1], -(second.depth - first.depth), atol=1e-6)


def test_slopes_are_exact_on_a_plane_and_one_sided_at_a_step() -> None:
    v, u = np.mgrid[0:240, 0:320].astype(np.float32)
    depth = 1 + 0.001 * u + 0.002 * v
    depth[:, 160:] += 0.5
    level = make_level(np.zeros_like(depth), depth, CAMERA)
    slopes = linearise.gradients(level, level)
    off_step = np.abs(u - 159.5) > 1
    np.testing.assert_allclose(slopes.depth[0][off_step], 0.001, atol=1e-5)
    np.testing.assert_allclose(slopes.depth[1][off_step], 0.002, atol=1e-5)
    # A plain central difference would be 0.25 beside the step.
    assert np.abs(slopes.depth[0]).max() < 0.01
    assert slopes.usable[1:-1, 1:-1].all()
    assert not slopes.usable[0].any()


def test_the_twist_is_robust_to_a_third_of_outliers() -> None:
    rng = np.random.default_rng(0)
    J = rng.standard_normal((3000, 2, 6)).astype(np.float32)
    true = np.array([0.01, -0.02, 0.03, 0.01, 0.0, -0.01])
    r = (J @ true + 1e-4 * rng.standard_normal((3000, 2))).astype(np.float32)
    r[:1000] += rng.uniform(0.05, 0.2, (1000, 2)).astype(np.float32)
    least_squares = np.linalg.lstsq(J.reshape(-1, 6), r.ravel(), rcond=None)[0]
    found = solve.solve_twist(J, r, None, 16.0, least_squares_start=False)
    assert np.abs(found - true).max() < 1e-3
    assert np.abs(found - true).max() < 0.3 * np.abs(least_squares - true).max()


def test_repeats_are_equivalent_to_repeated_rows() -> None:
    rng = np.random.default_rng(1)
    J = rng.standard_normal((50, 2, 6)).astype(np.float32)
    r = rng.standard_normal((50, 2)).astype(np.float32)
    repeats = rng.integers(1, 4, 50)
    repeated = solve.solve_twist(J.repeat(repeats, 0), r.repeat(repeats, 0), None, 1.0, least_squares_start=True)
    counted = solve.solve_twist(J, r, repeats.astype(np.float32), 1.0, least_squares_start=True)
    np.testing.assert_allclose(counted, repeated, atol=1e-4)


def test_too_few_pixels_give_no_motion_and_unconstrained_directions_stay_zero() -> None:
    J, r = np.ones((5, 2, 6), np.float32), np.ones((5, 2), np.float32)
    assert (solve.solve_twist(J, r, None, 1.0, least_squares_start=True) == 0).all()
    # Only the sum of the six parameters is constrained; the minimum-norm solution distributes it evenly.
    J, r = np.ones((50, 2, 6), np.float32), np.ones((50, 2), np.float32)
    np.testing.assert_allclose(solve.solve_twist(J, r, None, 1.0, least_squares_start=True), 1 / 6, rtol=1e-4)


# --- segmentation ---


def chain(connected: bool, z: float = 1.0) -> Clusters:
    """24 clusters at one depth, each connected to the next or to none."""
    centers = np.stack([np.arange(COUNT), np.zeros(COUNT), np.full(COUNT, z)], axis=1).astype(np.float32)
    index = np.arange(COUNT)
    near = np.abs(index[:, None] - index) <= (1 if connected else 0)
    return Clusters(centers, np.ones(COUNT, bool), near)


def test_unconnected_clusters_depend_on_their_own_residuals_only() -> None:
    residuals = np.full(COUNT, 0.002)
    residuals[:3] = 0.0105, 0.1, 0.007  # The unit has its minimum of 0.007; the limits are 0.007 and 0.014.
    b = segment.solve_labels(residuals, 0.0, chain(connected=False))
    np.testing.assert_allclose(b[:4], [0.5, 2, 0, 0], atol=1e-9)
    assert segment.solve_labels(residuals, 0.1, chain(connected=False))[0] < 0.1  # A fast camera raises the limits.


def test_connected_clusters_are_coupled_as_in_the_normal_equations() -> None:
    residuals = np.full(COUNT, 0.002)
    residuals[5] = 0.03
    clusters = chain(connected=True)
    b = segment.solve_labels(residuals, 0.0, clusters)
    target = np.clip((residuals - 0.007) / 0.007, 0, 2)
    confidence = np.hypot((residuals - 0.0105) / 0.0035, 1)
    normal = np.diag(confidence**2)
    for k in range(COUNT - 1):
        normal[k, k] += 0.25
        normal[k + 1, k + 1] += 0.25
        normal[k, k + 1] -= 0.25
        normal[k + 1, k] -= 0.25
    np.testing.assert_allclose(b, np.linalg.solve(normal, confidence**2 * target), atol=1e-9)
    assert b[5] > segment.MOVING
    assert 0 < b[4] < segment.STATIC


def test_the_prior_favours_static_for_distant_clusters_and_unused_ones_are_zero() -> None:
    residuals = np.full(COUNT, 0.002)
    residuals[[0, 1, 2]] = 0.012
    clusters = chain(connected=False)
    clusters.centers[1, 2] = 3
    clusters.used[2] = False
    b = segment.solve_labels(residuals, 0.0, clusters)
    near = (0.012 - 0.007) / 0.007
    confidence = np.hypot((0.012 - 0.0105) / 0.0035, 1)
    prior = 0.15 * (np.exp(3) - np.exp(0.75 * 1 + 0.25 * 3))
    np.testing.assert_allclose(b[:3], [near, confidence * near / (confidence + prior), 0], rtol=1e-6)
