"""The steps of SR-Flow against closed forms, loops and other libraries."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from objectflow import geometry
from objectflow.methods.baselines.sr_flow import smooth, twists
from objectflow.methods.baselines.sr_flow.pyramid import Level, build_pyramid
from objectflow.methods.baselines.sr_flow.residuals import Weights, compute_residuals

INTRINSICS = torch.tensor([[50.0, 48.0, 20.0, 14.0]])


def step_image(left: list[float], right: list[float], columns: tuple[int, int]) -> Tensor:
    """(1, C, 4, W) image with one colour on the left and another on the right."""
    sides = [torch.tensor(side)[:, None].expand(-1, n) for side, n in zip((left, right), columns, strict=True)]
    return torch.cat(sides, dim=1)[None, :, None].expand(1, -1, 4, -1).contiguous()


# --- smoothing ---


def test_each_side_of_a_step_moves_by_eta_over_its_width() -> None:
    field = step_image([0.0, 5.0], [1.0, 3.0], (8, 12))
    out, _ = smooth.smooth(field, 0.6, 3000, vectorial=False)
    expected = step_image([0 + 0.6 / 8, 5 - 0.6 / 8], [1 - 0.6 / 12, 3 + 0.6 / 12], (8, 12))
    torch.testing.assert_close(out, expected, atol=1e-4, rtol=0)


def test_vectorial_smoothing_moves_the_sides_along_the_step() -> None:
    field = step_image([0.0, 0.0, 1.0], [3.0, 4.0, 1.0], (8, 12))
    out, _ = smooth.smooth(field, 0.6, 3000, vectorial=True)
    along = torch.tensor([0.6, 0.8, 0.0])
    left, right = 0.6 / 8 * along, torch.tensor([3.0, 4.0, 1.0]) - 0.6 / 12 * along
    expected = step_image((left + torch.tensor([0.0, 0, 1])).tolist(), right.tolist(), (8, 12))
    torch.testing.assert_close(out, expected, atol=1e-4, rtol=0)


def test_a_small_step_is_flattened_to_the_mean() -> None:
    out, _ = smooth.smooth(step_image([0.0], [0.1], (4, 6)), 1.0, 500, vectorial=False)
    torch.testing.assert_close(out, torch.full_like(out, 0.06), atol=1e-4, rtol=0)


def test_smoothing_continues_from_its_dual() -> None:
    field = torch.from_numpy(np.random.default_rng(0).standard_normal((1, 3, 12, 16)).astype(np.float32))

    def energy(u: Tensor) -> float:
        tv = smooth.total_variation(u, vectorial=True)
        return float((u - field).square().sum() / 2 + 3.0 * tv[0])

    cold, dual = smooth.smooth(field, 3.0, 15, vectorial=True)
    warm, _ = smooth.smooth(field, 3.0, 15, vectorial=True, dual=dual)
    assert energy(warm) < energy(cold) < energy(field)


def test_total_variation_of_a_step_is_its_height_times_its_length() -> None:
    field = step_image([0.0, 0.0], [3.0, 4.0], (5, 5))
    assert math.isclose(float(smooth.total_variation(field, vectorial=False)[0]), 4 * (3 + 4), rel_tol=1e-6)
    assert math.isclose(float(smooth.total_variation(field, vectorial=True)[0]), 4 * 5, rel_tol=1e-6)


# --- twists ---


def test_points_move_by_the_exponential_map() -> None:
    rng = np.random.default_rng(1)
    twist, points = rng.standard_normal((6, 3, 4)), rng.standard_normal((3, 3, 4)) * 10
    twist[3:, 0, 0], twist[3:, 0, 1] = 0, [1e-5, 0, -2e-5]
    rotation, shift = twists.motions(torch.from_numpy(twist)[None])
    moved = points + twists.displace(rotation, shift, torch.from_numpy(points)[None])[0].numpy()
    for row in range(3):
        for column in range(4):
            a_T_b = geometry.se3_exp(twist[:, row, column])
            expected = geometry.transform(a_T_b, points[:, row, column])
            np.testing.assert_allclose(moved[:, row, column], expected, atol=1e-9)


def test_small_systems_are_solved_as_by_numpy() -> None:
    rng = np.random.default_rng(2)
    J, r, w = rng.standard_normal((9, 6, 2, 3)), rng.standard_normal((9, 2, 3)), rng.uniform(0.1, 2, (9, 2, 3))
    r_t, J_t, w_t = (torch.from_numpy(a) for a in (r, J.swapaxes(0, 1).copy(), w))
    diagonal, extra, damping = rng.uniform(0.1, 1, 6), rng.standard_normal((6, 2, 3)), rng.uniform(0, 1, (2, 3))
    solution = twists.solve(
        twists.normal_equations(r_t.flatten(1), J_t.flatten(2), w_t.flatten(1)),
        torch.from_numpy(diagonal)[:, None],
        torch.from_numpy(extra).flatten(1),
        torch.from_numpy(damping).flatten(),
    )
    x = solution.view(6, 2, 3).numpy()
    for row in range(2):
        for column in range(3):
            Jk, wk = J[:, :, row, column], w[:, row, column]
            A = (Jk * wk[:, None]).T @ Jk + np.diag(diagonal)
            A += damping[row, column] * np.diag(np.diag(A))
            b = (Jk * wk[:, None]).T @ r[:, row, column] + extra[:, row, column]
            np.testing.assert_allclose(x[:, row, column], -np.linalg.solve(A, b), atol=1e-9)


# --- the data term ---


def ramp_level() -> Level:
    """A level with linear intensity and depth, whose gradients are exact except at the border."""
    v, u = torch.meshgrid(torch.arange(30.0), torch.arange(40.0), indexing="ij")
    gray, depth = 0.2 + 0.01 * u + 0.005 * v, 0.6 + 0.002 * u - 0.001 * v
    frame = gray.expand(1, 3, -1, -1), depth[None, None]
    return build_pyramid(frame, frame, INTRINSICS, 1)[0]


def residuals_at(level: Level, moved: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    found = compute_residuals(level, moved, level.gray, level.valid, Weights(1.0, 0.1))
    (r_i, g_i, _), (r_z, g_z, _) = found.terms
    return r_i, g_i, r_z, g_z


def test_gradients_agree_with_finite_differences_of_the_residuals() -> None:
    level = ramp_level()
    inner = (0, slice(8, 22), slice(8, 32))
    start = level.points + torch.tensor([0.4, -0.3, 0.2]).view(1, 3, 1, 1)
    r_i, g_i, r_z, g_z = residuals_at(level, start)
    for axis in range(3):
        step = torch.zeros(1, 3, 1, 1)
        step[0, axis] = 0.05
        up, down = residuals_at(level, start + step), residuals_at(level, start - step)
        for gradient, plus, minus in ((g_i, up[0], down[0]), (g_z, up[2], down[2])):
            numeric = (plus - minus) / 0.1
            torch.testing.assert_close(gradient[:, axis][inner], numeric[inner], atol=2e-4, rtol=2e-2)
    assert float(r_i[inner].abs().max()) > 1e-3
    assert float(r_z[inner].abs().max()) > 1e-2


def test_outliers_and_points_out_of_view_have_constant_cost_and_no_weight() -> None:
    level = ramp_level()
    out_of_view = level.points + torch.tensor([500.0, 0, 0]).view(1, 3, 1, 1)
    far = level.points + torch.tensor([0.0, 0, 30]).view(1, 3, 1, 1)
    outlier_cost = math.sqrt(0.1 + 1e-6) + 0.1 * math.sqrt(10 + 1e-6)
    out = compute_residuals(level, out_of_view, level.gray, level.valid, Weights(1.0, 0.1))
    torch.testing.assert_close(out.cost, torch.full_like(out.cost, outlier_cost))
    assert all(float(weight.abs().max()) == 0 for _, _, weight in out.terms)
    out = compute_residuals(level, far, level.gray, level.valid, Weights(1.0, 0.1))
    assert float(out.terms[1][2].max()) == 0
    assert float(out.terms[0][2][0, 15, 20]) > 0
    out = compute_residuals(level, far, level.gray, torch.zeros_like(level.valid), Weights(1.0, 0.1))
    assert float(out.cost.abs().max()) == 0


# --- the pyramid ---


def test_levels_have_consistent_points_and_small_images_have_fewer_levels() -> None:
    color, depth = torch.rand(1, 3, 48, 64), torch.full((1, 1, 48, 64), 0.8)
    intrinsics = torch.tensor([[60.0, 60.0, 31.5, 23.5]])
    levels = build_pyramid((color, depth), (color, depth), intrinsics, 5)
    assert [tuple(level.gray.shape[2:]) for level in levels] == [(48, 64), (24, 32), (12, 16)]
    fine, coarse = levels[0].points, levels[1].points
    blocks = torch.nn.functional.avg_pool2d(fine, 2)
    torch.testing.assert_close(coarse, blocks, atol=1e-3, rtol=0)
    torch.testing.assert_close(levels[0].pivot[0, :, 0, 0], torch.tensor([0.0, 0.0, 80.0]), atol=1e-3, rtol=0)


def test_holes_remain_and_cause_no_gradients() -> None:
    depth = torch.full((1, 1, 20, 24), 0.8)
    depth[0, 0, 10, 12] = 0
    level = build_pyramid((torch.rand(1, 3, 20, 24), depth), (torch.rand(1, 3, 20, 24), depth), INTRINSICS, 1)[0]
    assert float(level.valid.sum()) == 20 * 24 - 1
    assert float(level.valid[0, 0, 10, 12]) == 0
    assert float(level.second[0, 4:6].abs().max()) < 1e-4
    assert float(level.second[0, 7].sum()) == 20 * 24 - 9
