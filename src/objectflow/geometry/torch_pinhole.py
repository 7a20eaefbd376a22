"""Projection and back-projection in torch, batch first and channels second."""

from __future__ import annotations

import torch
from torch import Tensor

from objectflow.errors import GeometryError
from objectflow.geometry.camera import Camera


def intrinsics(camera: Camera) -> Tensor:
    """(4,) float32 `fx, fy, cx, cy` in pixels; the other functions take them stacked to (B, 4)."""
    return torch.tensor([camera.fx, camera.fy, camera.cx, camera.cy], dtype=torch.float32)


def back_project(depth: Tensor, fx_fy_cx_cy: Tensor) -> Tensor:
    """Planar depth (B, 1, H, W) in metres and intrinsics (B, 4) -> points (B, 3, H, W) in the camera frame.

    Missing depth (0) gives the point 0, since NaN would propagate into gradients: mask with `depth > 0`.

    Raises:
        GeometryError: shapes that do not fit.
    """
    _check_map(depth, 1, fx_fy_cx_cy)
    fx, fy, cx, cy = fx_fy_cx_cy[..., None, None].unbind(1)
    u = torch.arange(depth.shape[3], dtype=depth.dtype, device=depth.device)
    v = torch.arange(depth.shape[2], dtype=depth.dtype, device=depth.device)[:, None]
    x, y = (u - cx) / fx, (v - cy) / fy
    z = depth[:, 0]
    return torch.stack([x * z, y * z, z], dim=1)


def project(points: Tensor, fx_fy_cx_cy: Tensor) -> tuple[Tensor, Tensor]:
    """Points (B, 3, H, W) and intrinsics (B, 4) -> pixels (B, 2, H, W) as (u, v), and (B, 1, H, W) bool: in front.

    Points at or behind the camera plane get pixel 0 and no gradient.

    Raises:
        GeometryError: shapes that do not fit.
    """
    _check_map(points, 3, fx_fy_cx_cy)
    in_front = points[:, 2:] > 1e-6
    ray = torch.where(in_front, points[:, :2], 0.0) / torch.where(in_front, points[:, 2:], 1.0)
    pixels = ray * fx_fy_cx_cy[:, :2, None, None] + fx_fy_cx_cy[:, 2:, None, None]
    return torch.where(in_front, pixels, 0.0), in_front


def _check_map(values: Tensor, channels: int, fx_fy_cx_cy: Tensor) -> None:
    if values.ndim != 4 or values.shape[1] != channels:
        raise GeometryError(f"expected a map (B, {channels}, H, W), not {tuple(values.shape)}")
    if fx_fy_cx_cy.ndim != 2 or fx_fy_cx_cy.shape[1] != 4 or fx_fy_cx_cy.shape[0] not in (1, values.shape[0]):
        raise GeometryError(
            f"expected intrinsics (B, 4) for a batch of {values.shape[0]}, not {tuple(fx_fy_cx_cy.shape)}"
        )


def depth_factor(points: Tensor, median: float) -> Tensor:
    """(B,) factor that brings each frame's median depth to `median` metres; 1 without any depth, or for a median of 0.

    Args:
        points: (B, 3, H, W) metres, NaN where depth is missing.
        median: metres.
    """
    ones = points.new_ones(len(points))
    if median == 0:
        return ones
    found = points[:, 2].flatten(1).nanmedian(dim=1).values
    return torch.where(found > 0, median / found, ones)
