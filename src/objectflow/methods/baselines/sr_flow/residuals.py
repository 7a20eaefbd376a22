"""The data term of SR-Flow: residuals of a moved point against the second frame's intensity and depth.

For a point Y of the first frame after its motion (equations 6 and 7 of the paper):

    r_I = I2(pi(Y)) - I1(x),    r_Z = Z2(pi(Y)) - Y_z,    cost = psi(r_I^2) + w_Z psi(r_Z^2)

with psi(s) = sqrt(s + 1e-6), truncated for outliers. Points that leave the image or have no depth there cost as much
as outliers, so that moving out of view never lowers the cost. psi is concave in s, so iteratively reweighted least
squares with the weights 2 psi'(r^2) lower the true cost.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from objectflow.methods.baselines.sr_flow.pyramid import Level

EPSILON = 1e-6
MAX_INTENSITY2 = 0.1
"""Squared intensity difference (intensities 0..1) above which a residual is an outlier."""

MAX_DEPTH2 = 10.0
"""Squared depth difference above which a residual is an outlier, cm^2."""


@dataclass(frozen=True)
class Weights:
    """Weights of the two terms, for intensities in 0..1 and depth in cm."""

    intensity: float
    depth: float


@dataclass(frozen=True, eq=False)
class Residuals:
    """Residuals of (B, H, W) points.

    Attributes:
        cost: (B, H, W); 0 for pixels that are not `valid`.
        terms: intensity, then depth: residual (B, H, W), its gradient with respect to the moved point (B, 3, H, W),
            and its weight (B, H, W), 0 for outliers.
    """

    cost: Tensor
    terms: tuple[tuple[Tensor, Tensor, Tensor], tuple[Tensor, Tensor, Tensor]]


def compute_residuals(level: Level, moved: Tensor, gray: Tensor, valid: Tensor, weights: Weights) -> Residuals:
    """Compare moved points with the second frame.

    Args:
        level: its second frame and camera.
        moved: (B, 3, H, W) points after their motion, cm.
        gray, valid: (B, 1, H, W) intensity of the points in the first frame, and 1 where a point exists.
        weights: of the two terms.
    """
    height, width = level.second.shape[2:]
    fx, fy, cx, cy = level.intrinsics[:, :, None, None].unbind(1)
    x, y, z = moved.unbind(1)
    gray, valid = gray[:, 0], valid[:, 0]
    inverse = z.clamp(min=1e-3).reciprocal_()
    ray_x, ray_y = x * inverse, y * inverse
    grid = z.new_empty(*z.shape, 2)
    for axis, (ray, focal, centre, side) in enumerate(((ray_x, fx, cx, width), (ray_y, fy, cy, height))):
        # `grid_sample` expects coordinates in -1..1.
        half = max(side - 1, 1e-3) / 2
        torch.addcmul(centre / half - 1, ray, focal / half, out=grid[..., axis])
    in_view = valid * ((grid[..., 0].abs() <= 1) & (grid[..., 1].abs() <= 1) & (z > 1e-3))
    sampled = functional.grid_sample(level.second, grid, mode="bilinear", padding_mode="border", align_corners=True)
    intensity, iu, iv, depth, zu, zv, has_depth, has_gradient = sampled.unbind(1)
    fx_z, fy_z = fx * inverse, fy * inverse

    r_i = intensity - gray
    g_i = _point_gradient(iu * fx_z, iv * fy_z, ray_x, ray_y)
    cost_i, w_i = _robust(r_i, in_view, MAX_INTENSITY2, weights.intensity)

    r_z = depth - z
    g_z = _point_gradient(zu * fx_z, zv * fy_z, ray_x, ray_y)
    g_z[:, 2] -= 1
    # A sample is invalid if it includes a missing pixel.
    cost_z, w_z = _robust(r_z, in_view * (has_depth > 0.999), MAX_DEPTH2, weights.depth)
    cost = (cost_i + cost_z) * valid
    return Residuals(cost, ((r_i, g_i, w_i), (r_z, g_z, w_z * (has_gradient > 0.999))))


def _point_gradient(along_x: Tensor, along_y: Tensor, ray_x: Tensor, ray_y: Tensor) -> Tensor:
    """Gradient of an image value with respect to the point; `along_x` is its derivative along u times fx / z."""
    return torch.stack([along_x, along_y, torch.addcmul(along_x * ray_x, along_y, ray_y).neg_()], dim=1)


def _robust(residual: Tensor, in_view: Tensor, limit2: float, weight: float) -> tuple[Tensor, Tensor]:
    """Truncated robust cost of a residual, and its weight for reweighted least squares."""
    square = residual * residual
    inlier = in_view * (square < limit2)
    root = square.add_(EPSILON).sqrt_()
    outlier_cost = math.sqrt(limit2 + EPSILON)
    weights = (inlier / root).mul_(weight)
    return root.sub_(outlier_cost).mul_(inlier).add_(outlier_cost).mul_(weight), weights
