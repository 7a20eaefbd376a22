"""The steps of `vo-sf`, each against something simpler that says the same."""

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
        # The image's corner, half a pixel beyond the first centre, is seen along one ray at every level.
        camera = level.camera
        np.testing.assert_allclose((-0.5 - camera.cx) / camera.fx, -160 / 264, rtol=1e-6)
        np.testing.assert_allclose(level.points[0, 0, 0], 1.5 * (0 - camera.cx) / camera.fx, rtol=1e-5)


def test_halving_mixes_no_surfaces_and_fills_small_holes() -> None:
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
    own = np.sort(block[1:3, 1:3].ravel())[-2]
    weight = np.outer([1, 2, 2, 1], [1, 2, 2, 1]) * (0.1 - np.abs(block - own))
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


def test_labels_are_the_nearest_centres_and_24_on_holes(scene: tuple[list[Level], Clusters]) -> None:
    levels, clusters = scene
    points = levels[0].points
    distance, nearest = cKDTree(clusters.centers).query(points.reshape(-1, 3))
    labels, soft = clusters.assign(points)
    np.testing.assert_array_equal(labels, clusters.labels(points))
    missing = points[..., 2] == 0
    assert (labels[missing] == COUNT).all()
    agree = (labels.ravel() == nearest) | missing.ravel()
    # Single precision may decide ties otherwise.
    own = np.linalg.norm(points.reshape(-1, 3) - clusters.centers[np.minimum(labels.ravel(), COUNT - 1)], axis=1)
    assert (agree | (np.abs(own - distance) < 1e-5)).all()
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
        weight = np.where(clusters.touching[labels[v, u]] & (exponent < 6), np.exp(-exponent), 0)
        np.testing.assert_allclose(soft[v, u], weight / weight.sum(), atol=3e-3)


def test_clusters_touch_on_a_surface_and_not_across_a_gap(scene: tuple[list[Level], Clusters]) -> None:
    levels, clusters = scene
    np.testing.assert_array_equal(clusters.touching, clusters.touching.T)
    assert clusters.touching.diagonal().all()
    labels = clusters.labels(levels[0].points)
    box = np.zeros((240, 320), bool)
    box[60:180, 100:250] = True
    inside, outside = (np.setdiff1d(np.unique(labels[mask]), [COUNT]) for mask in (box, ~box))
    assert not set(inside) & set(outside)
    assert not clusters.touching[np.ix_(inside, outside)].any()
    # Each wall is in one piece, so that each of its clusters touches another.
    assert (clusters.touching[np.ix_(inside, inside)].sum(1) > 1).all()
    assert (clusters.touching[np.ix_(outside, outside)].sum(1) > 1).all()


# --- warping ---


def test_warps_by_no_motion_change_nothing() -> None:
    level = build_pyramid(frame(two_walls()))[0]
    splat = warp.splat_second(level, np.eye(4))
    inner = np.s_[:-1, :-1]
    np.testing.assert_allclose(splat.depth[inner], level.depth[inner], rtol=1e-6)
    np.testing.assert_allclose(splat.gray[inner], level.gray[inner], atol=1e-6)
    still = np.broadcast_to(np.eye(4, dtype=np.float32)[:3], (240, 320, 3, 4))
    fetched = warp.fetch_second(level, level, still)
    within = np.s_[1:-1, 1:-1]
    np.testing.assert_allclose(fetched.depth[within], level.depth[within], rtol=1e-5)
    np.testing.assert_allclose(fetched.gray[within], level.gray[within], atol=1e-4)


def test_a_wall_moved_by_whole_pixels_warps_onto_itself() -> None:
    wall = np.full((240, 320), 2, np.float32)
    second = build_pyramid(frame(wall))[0]
    first = Level(np.roll(second.gray, (3, 5), (0, 1)), second.points, second.camera)
    motion = np.eye(4)
    motion[:3, 3] = 5 * 2 / 264, 3 * 2 / 264, 0  # first_T_second
    for warped in (
        warp.splat_second(second, motion),
        warp.fetch_second(second, first, np.tile(geometry.inverse(motion)[:3].astype(np.float32), (240, 320, 1, 1))),
    ):
        inner = np.s_[8:-8, 8:-8]
        np.testing.assert_allclose(warped.depth[inner], 2, rtol=1e-5)
        np.testing.assert_allclose(warped.gray[inner], first.gray[inner], atol=2e-3)


def test_fetching_takes_the_motion_in_depth_off_again() -> None:
    first = build_pyramid(frame(np.full((240, 320), 2, np.float32)))[0]
    second = build_pyramid(frame(np.full((240, 320), 2.1, np.float32)))[0]
    away = np.tile(np.eye(4, dtype=np.float32)[:3], (240, 320, 1, 1))
    away[..., 2, 3] = 0.1
    fetched = warp.fetch_second(second, first, away)
    np.testing.assert_allclose(fetched.depth[20:-20, 20:-20], 2, rtol=1e-5)


# --- constraints and their solution ---


def test_constraints_say_what_a_moved_point_does_to_the_images() -> None:
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
    deep = dz - (slopes.depth[0] * du + slopes.depth[1] * dv)
    np.testing.assert_allclose(J[..., 0, :] @ twist, 0.15 * gray, atol=2e-6)
    np.testing.assert_allclose(J[..., 1, :] @ twist, deep, atol=2e-6)
    np.testing.assert_allclose(r[..., 0], -0.15 * (second.gray - first.gray), atol=1e-6)
    np.testing.assert_allclose(r[..., 1], -(second.depth - first.depth), atol=1e-6)


def test_slopes_are_exact_on_a_plane_and_stay_on_their_side_of_a_step() -> None:
    v, u = np.mgrid[0:240, 0:320].astype(np.float32)
    depth = 1 + 0.001 * u + 0.002 * v
    depth[:, 160:] += 0.5
    level = make_level(np.zeros_like(depth), depth, CAMERA)
    slopes = linearise.gradients(level, level)
    away = np.abs(u - 159.5) > 1
    np.testing.assert_allclose(slopes.depth[0][away], 0.001, atol=1e-5)
    np.testing.assert_allclose(slopes.depth[1][away], 0.002, atol=1e-5)
    # A plain central difference would be 0.25 beside the step.
    assert np.abs(slopes.depth[0]).max() < 0.01
    assert slopes.usable[1:-1, 1:-1].all()
    assert not slopes.usable[0].any()


def test_the_twist_survives_a_third_of_outliers() -> None:
    rng = np.random.default_rng(0)
    J = rng.standard_normal((3000, 2, 6)).astype(np.float32)
    true = np.array([0.01, -0.02, 0.03, 0.01, 0.0, -0.01])
    r = (J @ true + 1e-4 * rng.standard_normal((3000, 2))).astype(np.float32)
    r[:1000] += rng.uniform(0.05, 0.2, (1000, 2)).astype(np.float32)
    plain = np.linalg.lstsq(J.reshape(-1, 6), r.ravel(), rcond=None)[0]
    found = solve.solve_twist(J, r, None, 16.0, plain_start=False)
    assert np.abs(found - true).max() < 1e-3
    assert np.abs(found - true).max() < 0.3 * np.abs(plain - true).max()


def test_a_repeated_row_counts_as_often_as_it_is_repeated() -> None:
    rng = np.random.default_rng(1)
    J = rng.standard_normal((50, 2, 6)).astype(np.float32)
    r = rng.standard_normal((50, 2)).astype(np.float32)
    repeats = rng.integers(1, 4, 50)
    written_out = solve.solve_twist(J.repeat(repeats, 0), r.repeat(repeats, 0), None, 1.0, plain_start=True)
    counted = solve.solve_twist(J, r, repeats.astype(np.float32), 1.0, plain_start=True)
    np.testing.assert_allclose(counted, written_out, atol=1e-4)


def test_few_pixels_say_nothing_and_a_flat_wall_no_more_than_it_can() -> None:
    J, r = np.ones((5, 2, 6), np.float32), np.ones((5, 2), np.float32)
    assert (solve.solve_twist(J, r, None, 1.0, plain_start=True) == 0).all()
    # Only the sum of the six numbers is seen: the shortest solution shares it out evenly.
    J, r = np.ones((50, 2, 6), np.float32), np.ones((50, 2), np.float32)
    np.testing.assert_allclose(solve.solve_twist(J, r, None, 1.0, plain_start=True), 1 / 6, rtol=1e-4)


# --- segmentation ---


def chain(touching: bool, z: float = 1.0) -> Clusters:
    """24 clusters at one depth, each touching the next or none."""
    centers = np.stack([np.arange(COUNT), np.zeros(COUNT), np.full(COUNT, z)], axis=1).astype(np.float32)
    index = np.arange(COUNT)
    near = np.abs(index[:, None] - index) <= (1 if touching else 0)
    return Clusters(centers, np.ones(COUNT, bool), near)


def test_clusters_apart_are_judged_by_their_own_residuals() -> None:
    residuals = np.full(COUNT, 0.002)
    residuals[:3] = 0.0105, 0.1, 0.007  # the unit is its least value, 0.007, with limits at 0.007 and 0.014
    b = segment.solve_labels(residuals, 0.0, chain(touching=False))
    np.testing.assert_allclose(b[:4], [0.5, 2, 0, 0], atol=1e-9)
    assert segment.solve_labels(residuals, 0.1, chain(touching=False))[0] < 0.1  # a fast camera raises the limits


def test_touching_clusters_pull_on_each_other_as_least_squares_has_it() -> None:
    residuals = np.full(COUNT, 0.002)
    residuals[5] = 0.03
    clusters = chain(touching=True)
    b = segment.solve_labels(residuals, 0.0, clusters)
    target = np.clip((residuals - 0.007) / 0.007, 0, 2)
    trust = np.hypot((residuals - 0.0105) / 0.0035, 1)
    normal = np.diag(trust**2)
    for k in range(COUNT - 1):
        normal[k, k] += 0.25
        normal[k + 1, k + 1] += 0.25
        normal[k, k + 1] -= 0.25
        normal[k + 1, k] -= 0.25
    np.testing.assert_allclose(b, np.linalg.solve(normal, trust**2 * target), atol=1e-9)
    assert b[5] > segment.MOVING
    assert 0 < b[4] < segment.STATIC


def test_far_clusters_are_rather_static_and_absent_ones_are_nothing() -> None:
    residuals = np.full(COUNT, 0.002)
    residuals[[0, 1, 2]] = 0.012
    clusters = chain(touching=False)
    clusters.centers[1, 2] = 3
    clusters.used[2] = False
    b = segment.solve_labels(residuals, 0.0, clusters)
    near = (0.012 - 0.007) / 0.007
    trust = np.hypot((0.012 - 0.0105) / 0.0035, 1)
    prior = 0.15 * (np.exp(3) - np.exp(0.75 * 1 + 0.25 * 3))
    np.testing.assert_allclose(b[:3], [near, trust * near / (trust + prior), 0], rtol=1e-6)
