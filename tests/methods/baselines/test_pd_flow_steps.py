"""The steps of `pd-flow`, each against a simpler reference implementation."""

from __future__ import annotations

import itertools
from functools import cache

import numpy as np
import pytest
import torch
from scipy import ndimage, optimize
from torch import Tensor

import analytic
from objectflow import Camera, geometry
from objectflow.alignment.appearance import to_gray
from objectflow.geometry import torch_pinhole
from objectflow.methods.baselines.guided_upsampling import upsample_guided
from objectflow.methods.baselines.pd_flow import linearise, median, primal_dual, pyramid
from objectflow.methods.baselines.pd_flow.estimator import lift
from objectflow.methods.baselines.pd_flow.primal_dual import State
from objectflow.typing import Float32Array, Float64Array

K = torch.tensor([[60.0, 60.0, 31.5, 23.5]])


def random_images(seed: int = 0, *, batch: int = 1, height: int = 48, width: int = 64) -> pyramid.Images:
    generator = torch.Generator().manual_seed(seed)
    gray = 255 * torch.rand(batch, 1, height, width, generator=generator)
    depth = 1 + 0.05 * torch.rand(batch, 1, height, width, generator=generator)
    return pyramid.Images(gray, depth, K.expand(batch, 4))


# --- pyramid ---


def test_gray_is_filtered_by_the_binomial_kernel_and_subsampled() -> None:
    images = random_images()
    coarse = pyramid.build_pyramid(images, 2)[1]
    row = np.array([1, 4, 6, 4, 1]) / 16
    smooth = ndimage.convolve(images.gray[0, 0].numpy(), np.outer(row, row))
    np.testing.assert_allclose(coarse.gray[0, 0, 1:-1, 1:-1], smooth[::2, ::2][1:-1, 1:-1], rtol=1e-4)
    np.testing.assert_allclose(coarse.intrinsics, K / 2)


def test_levels_halve_and_constants_are_preserved() -> None:
    images = random_images()._replace(gray=torch.full((1, 1, 48, 64), 80.0), depth=torch.full((1, 1, 48, 64), 1.5))
    levels = pyramid.build_pyramid(images)
    assert [tuple(level.depth.shape[2:]) for level in levels] == [(48, 64), (24, 32), (12, 16), (6, 8), (3, 4)]
    for level in levels:
        np.testing.assert_allclose(level.gray, 80, rtol=1e-5)
        np.testing.assert_allclose(level.depth, 1.5, rtol=1e-5)


def test_depth_is_not_mixed_across_edges_and_holes_remain() -> None:
    depth = torch.full((1, 1, 48, 64), 2.0)
    depth[..., 20:, 17:] = 1.2
    depth[..., 10, 10] = 0
    depth[..., 31, 31] = 0
    coarse = pyramid.build_pyramid(random_images()._replace(depth=depth), 2)[1].depth[0, 0]
    assert coarse[5, 5] == 0  # The pixel that is kept was missing.
    assert (coarse > 0).sum() == coarse.numel() - 1
    known = coarse[coarse > 0]
    assert torch.minimum((known - 2).abs(), (known - 1.2).abs()).max() < 1e-5


def test_upsampling_preserves_planes() -> None:
    v, u = torch.meshgrid(torch.arange(6.0), torch.arange(8.0), indexing="ij")
    fine = pyramid.upsample_flow((3 + 2 * u - v)[None, None])[0, 0]
    v, u = torch.meshgrid(torch.arange(12.0), torch.arange(16.0), indexing="ij")
    np.testing.assert_allclose(fine[2:-3, 2:-3], (3 + u - v / 2)[2:-3, 2:-3], atol=1e-5)
    np.testing.assert_allclose(pyramid.upsample_flow(torch.full((1, 2, 6, 8), 4.0)), 4, rtol=1e-5)


# --- linearisation ---


def test_derivatives_are_taken_at_the_warped_pixels() -> None:
    v, u = np.mgrid[0:48, 0:64].astype(np.float32)
    plane = lambda x, y: (20 + 3 * x - 2 * y, 1 + 0.004 * x + 0.002 * y)  # noqa: E731
    second = random_images()._replace(**dict(zip(("gray", "depth"), _maps(*plane(u, v)), strict=True)))
    first = random_images()._replace(**dict(zip(("gray", "depth"), _maps(*plane(u + 2.3, v - 1.6)), strict=True)))
    flow = torch.tensor([2.3, -1.6])[None, :, None, None].expand(1, 2, 48, 64)
    level = linearise.linearise(first, second, flow)
    inner = np.s_[0, :, 5:-5, 5:-5]
    for found, expected in ((level.gray, (3, -2, 0)), (level.depth, (0.004, 0.002, 0))):
        flat = np.broadcast_to(np.array(expected)[:, None, None], found[inner].shape)
        np.testing.assert_allclose(found[inner], flat, atol=2e-4 * max(np.abs(expected)) + 1e-6)
    np.testing.assert_allclose(level.mu[inner], 75 / (1 + 1000 * (0.004**2 + 0.002**2)), rtol=1e-4)


def _maps(gray: Float32Array, depth: Float32Array) -> tuple[Tensor, Tensor]:
    return torch.from_numpy(gray)[None, None], torch.from_numpy(depth)[None, None]


def test_sampling_is_bilinear_and_clamped_to_the_image() -> None:
    first, second = random_images(1), random_images(2)
    flow = 6 * torch.randn(1, 2, 48, 64, generator=torch.Generator().manual_seed(3))
    level = linearise.linearise(first, second, flow)
    v, u = np.mgrid[0:48, 0:64]
    coordinates = [v + flow[0, 1].numpy(), u + flow[0, 0].numpy()]
    for change, a, b in ((level.gray, first.gray, second.gray), (level.depth, first.depth, second.depth)):
        expected = ndimage.map_coordinates(b[0, 0].numpy(), coordinates, order=1, mode="nearest") - a[0, 0].numpy()
        np.testing.assert_allclose(change[0, 2], expected, atol=2e-3)


def test_depth_beside_a_hole_is_that_of_the_nearest_pixel_and_in_it_unknown() -> None:
    second = random_images()
    depth = second.depth.clone()
    depth[..., 20, 30] = 0
    flow = torch.zeros(1, 2, 48, 64)
    flow[0, 0, 20, 28], flow[0, 0, 20, 27] = 1.3, 2.8  # To (29.3, 20) and (29.8, 20).
    first = random_images(5)
    level = linearise.linearise(first, second._replace(depth=depth), flow)
    np.testing.assert_allclose(level.depth[0, 2, 20, 28], depth[0, 0, 20, 29] - first.depth[0, 0, 20, 28], atol=1e-6)
    assert level.depth[0, 2, 20, 27] == 0
    assert level.depth[0, 2, 20, 30] == 0


def test_the_metric_is_two_over_the_step_on_the_surface() -> None:
    images = random_images()
    camera = Camera(64, 48, 60.0, 60.0, 31.5, 23.5)
    points = geometry.back_project(images.depth[0, 0].numpy(), camera).astype(np.float64)
    metric = linearise.linearise(images, images, torch.zeros(1, 2, 48, 64)).metric[0]
    along_u, along_v = np.diff(points, axis=1), np.diff(points, axis=0)
    np.testing.assert_allclose(metric[0, :, :-1], 2 / np.hypot(along_u[..., 0], along_u[..., 2]), rtol=1e-3)
    np.testing.assert_allclose(metric[1, :-1], 2 / np.hypot(along_v[..., 1], along_v[..., 2]), rtol=1e-3)


# --- solver ---


@cache
def small_level() -> linearise.Level:
    """A level of 30x40 of a scene with small motion, in double precision."""
    pair = analytic.make_scene(1, objects=(2, 4), motion=(0.003, 0.008), max_angle_deg=3)
    first, second = (
        pyramid.build_pyramid(
            pyramid.Images(
                torch.from_numpy(to_gray(frame.color)).double()[None, None],
                torch.from_numpy(frame.depth).double()[None, None],
                torch_pinhole.intrinsics(frame.camera).double()[None],
            )
        )[3]
        for frame in (pair.curr, pair.prev)
    )
    flow = 0.2 * torch.randn(1, 2, 30, 40, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    return linearise.linearise(first, second, flow)


def start() -> State:
    zero = torch.zeros(1, 7, 30, 40, dtype=torch.float64)
    return State(zero[:, :3], zero[:, :1], zero[:, 1:])


@cache
def after(iterations: int) -> State:
    return primal_dual.solve(small_level(), start(), iterations)


def dual_value(level: linearise.Level, state: State, box: float) -> float:
    """Lower bound of the energy over |u|, |v|, |w| <= box from the dual variables (weak duality)."""
    weight = primal_dual.smooth_weights(level.metric)[0].numpy() * state.smooth_dual[0].numpy()
    pd = state.depth_dual[0, 0].numpy()
    mu, (zu, zv, zt), (iu, iv, it) = level.mu[0, 0].numpy(), level.depth[0].numpy(), level.gray[0].numpy()
    linear = np.zeros((3, *pd.shape))  # Linear terms of the primal variables.
    along_u, along_v = weight[:3], weight[3:]
    linear[:, :, 1:] += along_u[:, :, :-1]
    linear[:, :, :-1] -= along_u[:, :, :-1]
    linear[:, 1:] += along_v[:, :-1]
    linear[:, :-1] -= along_v[:, :-1]
    linear += np.stack([zu, zv, -np.ones_like(zu)]) * mu * pd
    warp = level.warp[0].numpy()
    constant = (mu * zt * pd).sum()
    constant += (weight[:2, :, :-1] * np.diff(warp, axis=2)).sum() + (weight[3:5, :-1] * np.diff(warp, axis=1)).sum()
    # In u and v, a linear function plus |it + iu u + iv v| has its minimum at a corner of the box or where the line
    # it + iu u + iv v = 0 intersects the box.
    corners = [(a, b) for a in (-box, box) for b in (-box, box)]
    candidates = [(np.full_like(iu, a), np.full_like(iu, b)) for a, b in corners]
    with np.errstate(divide="ignore", invalid="ignore"):
        candidates += [(np.full_like(iu, a), -(it + iu * a) / iv) for a in (-box, box)]
        candidates += [(-(it + iv * b) / iu, np.full_like(iu, b)) for b in (-box, box)]
        values = [
            np.where(
                (np.abs(u) <= box) & (np.abs(v) <= box),
                linear[0] * u + linear[1] * v + np.abs(it + iu * u + iv * v),
                np.inf,
            )
            for u, v in candidates
        ]
    return float(constant + np.min(values, axis=0).sum() - box * np.abs(linear[2]).sum())


def test_the_primal_dual_gap_converges_to_zero() -> None:
    box, gaps = 3.0, []
    for iterations in (10, 40, 160, 2000):
        state = after(iterations)
        assert state.flow.abs().max() < box
        gap = float(primal_dual.energy(small_level(), state.flow)[0]) - dual_value(small_level(), state, box)
        assert gap > -1e-6
        gaps.append(gap)
    assert all(later < 0.6 * sooner for sooner, later in itertools.pairwise(gaps))
    assert gaps[-1] < 0.01 * gaps[0]


def test_the_energy_decreases_to_the_minimum_found_by_a_general_optimiser() -> None:
    level = small_level()
    energies = [float(primal_dual.energy(level, after(n).flow)[0]) for n in (10, 40, 160, 2000)]
    assert energies == sorted(energies, reverse=True)

    def smoothed(x: Float64Array) -> tuple[float, Float64Array]:
        flow = torch.from_numpy(x).view(1, 3, 30, 40).requires_grad_()
        value = reference_energy(level, flow, 1e-3)
        value.backward()  # type: ignore[no-untyped-call]
        assert flow.grad is not None
        return float(value.detach()), flow.grad.numpy().ravel()

    options = {"maxiter": 3000, "maxfun": 5000}
    best = optimize.minimize(smoothed, np.zeros(3600), jac=True, method="L-BFGS-B", options=options)
    minimum = float(reference_energy(level, torch.from_numpy(best.x).view(1, 3, 30, 40), 0.0))
    assert energies[-1] <= 1.002 * minimum
    assert energies[1] < 1.2 * minimum  # 40 iterations, as on the coarsest level.


def reference_energy(level: linearise.Level, flow: Tensor, softness: float) -> Tensor:
    """The energy term by term, with |x| as sqrt(x^2 + softness^2)."""
    soft = lambda square: (square + softness**2 + 1e-30).sqrt().sum()  # noqa: E731
    u, v, w = flow[0]
    (iu, iv, it), (zu, zv, zt), mu, (ri, rj) = level.gray[0], level.depth[0], level.mu[0, 0], level.metric[0]
    total = soft((it + iu * u + iv * v).square())
    total = total + soft((mu * (zt + zu * u + zv * v - w)).square())
    for weight, field in ((0.04, level.warp[0, 0] + u), (0.04, level.warp[0, 1] + v), (0.35, w)):
        right, down = torch.zeros_like(field), torch.zeros_like(field)
        right[:, :-1] = weight * ri[:, :-1] * (field[:, 1:] - field[:, :-1])
        down[:-1] = weight * rj[:-1] * (field[1:] - field[:-1])
        total = total + soft(right.square() + down.square())
    return total


def test_the_energy_follows_its_formula() -> None:
    flow = torch.randn(1, 3, 30, 40, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    expected = float(reference_energy(small_level(), flow, 0.0))
    np.testing.assert_allclose(float(primal_dual.energy(small_level(), flow)[0]), expected, rtol=1e-9)


def test_duals_stay_in_the_unit_ball() -> None:
    state = after(40)
    assert state.depth_dual.abs().max() <= 1
    assert torch.hypot(state.smooth_dual[:, :3], state.smooth_dual[:, 3:]).max() < 1 + 1e-9


# --- median and lifting ---


def test_the_median_interpolates_the_sorted_weights() -> None:
    rng = np.random.default_rng(0)
    flow, depth, change = rng.standard_normal((2, 9, 7)), rng.uniform(1, 2, (9, 7)), 0.3 * rng.standard_normal((9, 7))
    depth[4, 4] = 0
    found = median.weighted_median(
        torch.from_numpy(flow)[None], torch.from_numpy(depth)[None, None], torch.from_numpy(change)[None, None]
    )[0].numpy()
    for c, v, u in np.ndindex(2, 9, 7):
        if depth[v, u] == 0:
            assert found[c, v, u] == flow[c, v, u]
            continue
        window = np.s_[max(v - 1, 0) : v + 2, max(u - 1, 0) : u + 2]
        weight = (1 / (1 + 5 * (depth[window] - depth[v, u]) ** 2 + 10 * change[window] ** 2)).ravel()
        values = flow[c][window].ravel()
        order = values.argsort()
        expected = np.interp(weight.sum() / 2, weight[order].cumsum(), values[order])
        np.testing.assert_allclose(found[c, v, u], expected, atol=1e-9)


def test_lifted_flow_leads_to_the_matched_point() -> None:
    camera = Camera(64, 48, 60.0, 62.0, 31.5, 23.5)
    rng = np.random.default_rng(0)
    depth = rng.uniform(1, 2, (48, 64)).astype(np.float32)
    uvw = rng.standard_normal((3, 48, 64)).astype(np.float32) * np.array([4, 4, 0.1], np.float32)[:, None, None]
    flow = lift(
        torch.from_numpy(uvw)[None], torch.from_numpy(depth)[None, None], torch_pinhole.intrinsics(camera)[None]
    )[0]
    reached = geometry.back_project(depth, camera) + flow.permute(1, 2, 0).numpy()
    v, u = np.mgrid[0:48, 0:64]
    np.testing.assert_allclose(geometry.project(reached, camera), np.stack([u + uvw[0], v + uvw[1]], -1), atol=1e-3)
    np.testing.assert_allclose(reached[..., 2], depth + uvw[2], atol=1e-6)


# --- guided upsampling ---


def test_the_same_size_leaves_values_unchanged() -> None:
    rng = np.random.default_rng(0)
    values = rng.standard_normal((12, 16, 3)).astype(np.float32)
    depth = rng.uniform(1, 2, (12, 16)).astype(np.float32)
    np.testing.assert_allclose(upsample_guided(values, depth, depth), values, atol=1e-6)


def test_planes_are_upsampled_exactly_and_surfaces_are_not_mixed() -> None:
    v, u = np.mgrid[0:24, 0:32].astype(np.float32)
    depth = np.where(u < 16, 1, 2).astype(np.float32)
    values = np.where(depth == 1, 5, u + 2 * v)[..., None].astype(np.float32)
    y, x = np.mgrid[0:72, 0:96].astype(np.float32)
    large = np.where(x < 48, 1, 2).astype(np.float32)
    out = upsample_guided(values, depth, large)[..., 0]
    np.testing.assert_allclose(out[large == 1], 5, atol=1e-4)
    inner = (x > 50) & (x < 93) & (y > 2) & (y < 69)
    np.testing.assert_allclose(out[inner], ((x + 0.5) / 3 - 0.5 + 2 * ((y + 0.5) / 3 - 0.5))[inner], atol=1e-3)
    beside = (x == 48) & (y > 2) & (y < 69)
    assert (np.abs(out[beside] - 16 - 2 * ((y + 0.5) / 3 - 0.5)[beside]) < 0.5).all()


def test_pixels_on_an_unknown_surface_take_the_nearest_value() -> None:
    depth = np.zeros((4, 4), np.float32)
    depth[1, 2] = 1
    values = np.full((4, 4, 1), 9, np.float32)
    values[1, 2] = 3
    assert (upsample_guided(values, depth, np.full((8, 8), 5, np.float32)) == 3).all()
    assert (upsample_guided(values, np.zeros_like(depth), np.ones((8, 8), np.float32)) == 0).all()


@pytest.mark.parametrize("shape", [(1, 1), (3, 5)])
def test_the_size_may_be_smaller(shape: tuple[int, int]) -> None:
    out = upsample_guided(
        np.full((12, 16, 2), 7, np.float32), np.ones((12, 16), np.float32), np.ones(shape, np.float32)
    )
    np.testing.assert_allclose(out, np.full((*shape, 2), 7), rtol=1e-6)
