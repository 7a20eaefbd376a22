"""Torch geometry against NumPy geometry and finite differences."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.autograd import gradcheck

from objectflow import Camera, geometry
from objectflow.errors import GeometryError
from objectflow.geometry import torch_pinhole
from objectflow.geometry import torch_se3 as tg

CAMERA = Camera(width=9, height=7, fx=10.0, fy=11.0, cx=4.2, cy=2.9)
ANGLES = [0.0, 1e-12, 1e-6, 1.9e-4, 2.1e-4, 1e-3, 0.1, 0.499, 0.501, 1.5, 3.0, np.pi - 1e-3]


def randn(*shape: int, seed: int = 0, dtype: torch.dtype = torch.float64) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64).to(dtype)


def vectors(angle: float) -> Tensor:
    """(5, 3) axis-angle vectors of one angle about coordinate axes and random axes."""
    axes = torch.cat([torch.eye(3, dtype=torch.float64), randn(2, 3)])
    scaled: Tensor = angle * axes / axes.norm(dim=-1, keepdim=True)
    return scaled


@pytest.mark.parametrize("angle", ANGLES)
def test_exponentials_agree_with_numpy(angle: float) -> None:
    w = vectors(angle)
    R = geometry.so3_exp(w.numpy())
    np.testing.assert_allclose(tg.so3_exp(w).numpy(), R, atol=1e-14)
    twist = torch.cat([randn(5, 3, seed=1), w], dim=-1)
    np.testing.assert_allclose(tg.se3_exp(twist).numpy(), geometry.se3_exp(twist.numpy()), atol=1e-11)
    single = tg.se3_exp(twist.float()).numpy()
    np.testing.assert_allclose(single, geometry.se3_exp(twist.numpy()), atol=3e-6)


@pytest.mark.parametrize("angle", ANGLES)
def test_gradients_of_the_exponentials_are_right(angle: float) -> None:
    w = vectors(angle).requires_grad_()
    twist = torch.cat([randn(5, 3, seed=1), vectors(angle)], dim=-1).requires_grad_()
    assert gradcheck(tg.so3_exp, w)
    assert gradcheck(tg.se3_exp, twist)


def test_gradients_of_so3_exp_stay_finite_in_single_precision_at_zero() -> None:
    w = torch.zeros(4, 3, requires_grad=True)
    (gradient,) = torch.autograd.grad(tg.so3_exp(w)[:, 2, 1].sum(), w)
    np.testing.assert_allclose(gradient.numpy(), np.tile([1.0, 0, 0], (4, 1)), atol=1e-6)


def kabsch(curr: Tensor, prev: Tensor, weights: Tensor) -> Tensor:
    """(..., 4, 4) weighted least-squares motion of points (..., N, 3), by the rotation nearest to their covariance."""
    total = weights.sum(-1, keepdim=True)
    w = (weights / torch.where(total > 0, total, 1.0))[..., None]
    p_mean, q_mean = (w * curr).sum(-2, keepdim=True), (w * prev).sum(-2, keepdim=True)
    R, _ = tg.nearest_rotation((w * (prev - q_mean)).mT @ (curr - p_mean))
    return tg.make_transform(R, (q_mean.mT - R @ p_mean.mT)[..., 0])


def test_nearest_rotations_agree_with_numpy() -> None:
    curr, prev, weights = randn(2, 4, 7, 3), randn(2, 4, 7, 3, seed=1), randn(2, 4, 7, seed=2).abs()
    curr[0, 1, :, 2] = 0  # on a plane
    expected, determined = geometry.kabsch(curr.numpy(), prev.numpy(), weights.numpy())
    assert determined.all()
    np.testing.assert_allclose(kabsch(curr, prev, weights).numpy(), expected, atol=1e-12)
    matrices = randn(5, 3, 3)
    for found, wanted in zip(tg.nearest_rotation(matrices), geometry.nearest_rotation(matrices.numpy()), strict=True):
        np.testing.assert_allclose(found.numpy(), wanted, atol=1e-12)


def test_gradients_of_nearest_rotations_are_right() -> None:
    curr, weights = randn(2, 6, 3).requires_grad_(), (randn(2, 6, seed=2).abs() + 0.1).requires_grad_()
    motion = tg.se3_exp(randn(2, 6, seed=4))
    moved = curr.detach() @ motion[:, :3, :3].mT + motion[:, None, :3, 3]
    prev = (moved + 0.1 * randn(2, 6, 3, seed=3)).requires_grad_()
    assert gradcheck(kabsch, (curr, prev, weights))
    mirrored = (curr.detach() * torch.tensor([1, 1, -1.0]) + 0.1 * randn(2, 6, 3, seed=3)).requires_grad_()
    assert gradcheck(kabsch, (curr, mirrored, weights))


def test_gradients_of_nearest_rotations_are_right_where_singular_values_are_equal() -> None:
    corners = torch.cat([torch.eye(3), -torch.eye(3)]).double()[None].requires_grad_()
    turned = (corners.detach() @ tg.so3_exp(randn(3)).mT).requires_grad_()
    weights = torch.ones(1, 6, dtype=torch.float64, requires_grad=True)
    assert gradcheck(kabsch, (corners, turned, weights))
    flat = randn(1, 6, 3) * torch.tensor([1, 1, 0.0])
    assert gradcheck(kabsch, (flat.requires_grad_(), flat.detach().flip(-1).requires_grad_(), weights))


@pytest.mark.parametrize("case", ["point", "line", "no weight", "empty"])
def test_gradients_of_nearest_rotations_stay_finite_where_they_are_undetermined(case: str) -> None:
    line = torch.linspace(0, 1, 5)[:, None] * torch.tensor([1.0, 2, 3])
    curr = {"point": torch.ones(5, 3), "line": line, "no weight": torch.randn(5, 3), "empty": torch.zeros(0, 3)}[case]
    curr = curr.clone().requires_grad_()
    weights = torch.full((len(curr),), 0.0 if case == "no weight" else 1.0, requires_grad=True)
    found = kabsch(curr, curr.detach() + 1, weights)
    for gradient in torch.autograd.grad(found.square().sum(), (curr, weights)):
        assert gradient.isfinite().all()


def test_back_projection_and_projection_agree_with_numpy() -> None:
    depth = randn(2, 1, 7, 9, dtype=torch.float32).abs() + 0.1
    depth[1, 0, 3, 4] = 0
    cameras = [CAMERA, Camera(9, 7, 12.0, 9.0, 3.0, 3.0)]
    k = torch.stack([torch_pinhole.intrinsics(camera) for camera in cameras])
    points = torch_pinhole.back_project(depth, k)
    pixels, in_front = torch_pinhole.project(points, k)
    assert in_front.logical_not().nonzero().tolist() == [[1, 0, 3, 4]]
    assert points[1, :, 3, 4].tolist() == [*pixels[1, :, 3, 4].tolist(), 0]
    for i, camera in enumerate(cameras):
        expected = geometry.back_project(depth[i, 0].numpy(), camera)
        np.testing.assert_allclose(points[i].permute(1, 2, 0), np.nan_to_num(expected), atol=1e-6)
        expected_pixels = geometry.project(expected, camera)
        np.testing.assert_allclose(pixels[i].permute(1, 2, 0), np.nan_to_num(expected_pixels), atol=1e-4)


def test_gradients_of_the_projections_are_right_and_zero_behind_the_camera() -> None:
    k = torch_pinhole.intrinsics(CAMERA)[None].double().requires_grad_()
    depth = (randn(2, 1, 3, 4).abs() + 0.5).requires_grad_()
    points = randn(2, 3, 3, 4)
    points[:, 2] = points[:, 2].abs() + 0.5
    assert gradcheck(torch_pinhole.back_project, (depth, k))
    assert gradcheck(lambda p, k: torch_pinhole.project(p, k)[0], (points.requires_grad_(), k))
    behind = torch.tensor([0.1, 0.2, 0.0]).reshape(1, 3, 1, 1).requires_grad_()
    (gradient,) = torch.autograd.grad(torch_pinhole.project(behind, k.float())[0].sum(), behind)
    assert gradient.flatten().tolist() == [0, 0, 0]


def test_rigid_flow_is_equation_1() -> None:
    points, Q, T, X = (randn(2, 3, 4, 5, seed=seed) for seed in range(4))
    Q[0, :, 0, 0] = 0
    Q[1] *= 1e-5
    flow = tg.rigid_flow(points, Q, T, X)
    for b, v, u in np.ndindex(2, 4, 5):
        R = geometry.so3_exp(Q[b, :, v, u].numpy())
        P, x, t = (a[b, :, v, u].numpy() for a in (points, X, T))
        np.testing.assert_allclose(flow[b, :, v, u], R @ (P - x) + x + t - P, atol=1e-12)


def test_rigid_flow_agrees_with_the_flow_of_one_object_and_broadcasts() -> None:
    depth = randn(7, 9, dtype=torch.float32).abs() + 0.5
    points = geometry.back_project(depth.numpy(), CAMERA)
    Q, T, X = (0.1 * randn(3, seed=seed) for seed in range(3))
    prev_T_curr = np.eye(4)
    prev_T_curr[:3, :3] = geometry.so3_exp(Q.numpy())
    prev_T_curr[:3, 3] = X.numpy() + T.numpy() - prev_T_curr[:3, :3] @ X.numpy()
    expected = geometry.flow_from_motions(points, np.ones((7, 9), np.int32), {1: prev_T_curr})
    one = [vector.float().reshape(1, 3, 1, 1) for vector in (Q, T, X)]
    flow = tg.rigid_flow(torch.from_numpy(points).permute(2, 0, 1)[None], *one)
    np.testing.assert_allclose(flow[0].permute(1, 2, 0), expected, atol=1e-6)


def test_gradients_of_rigid_flow_are_right_at_every_angle() -> None:
    Q = torch.stack([vectors(angle)[3:] for angle in ANGLES]).permute(2, 0, 1)[None].contiguous().requires_grad_()
    points, T, X = (randn(*Q.shape, seed=seed).requires_grad_() for seed in range(3))
    assert gradcheck(tg.rigid_flow, (points, Q, T, X))


def test_maps_that_do_not_fit_are_refused() -> None:
    k, good = torch_pinhole.intrinsics(CAMERA)[None], torch.zeros(2, 3, 4, 5)
    with pytest.raises(GeometryError, match="one shape"):
        tg.rigid_flow(good, good, good, torch.zeros(2, 3, 4, 4))
    with pytest.raises(GeometryError, match=r"maps \(B, 3, H, W\)"):
        tg.rigid_flow(good[0], good[0], good[0], good[0])
    with pytest.raises(GeometryError, match=r"map \(B, 1, H, W\)"):
        torch_pinhole.back_project(good, k)
    with pytest.raises(GeometryError, match="intrinsics"):
        torch_pinhole.project(good, k[0])
    with pytest.raises(GeometryError, match="batch of 2"):
        torch_pinhole.project(good, k.expand(3, 4))
