"""The data term of SR-Flow: how far a point, once moved, is from the second frame's intensity and depth.

For a point Y of the first frame after its motion (equations 6 and 7 of the paper):

    r_I = I2(pi(Y)) - I1(x),    r_Z = Z2(pi(Y)) - Y_z,    cost = psi(r_I^2) + w_Z psi(r_Z^2)

with psi(s) = sqrt(s + 1e-6), constant from where a residual is called an outlier. The same constant is paid where the
point leaves the image or meets no depth, so that hiding never pays. psi is concave in s: its tangent in r^2 lies above
it, and the weights 2 psi'(r^2) of iteratively reweighted least squares lower the true cost.
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
"""Squared intensity difference (0..1) of an outlier."""

MAX_DEPTH2 = 10.0
"""Squared depth difference of an outlier, cm^2."""


@dataclass(frozen=True)
class Weights:
    """Of the two terms, for intensities in 0..1 and depth in cm."""

    intensity: float
    depth: float


@dataclass(frozen=True, eq=False)
class Residuals:
    """Of (B, H, W) points.

    Attributes:
        cost: (B, H, W); 0 for pixels that are not `valid`.
        terms: intensity, then depth: residual (B, H, W), its gradient along the moved point (B, 3, H, W), and its
            weight (B, H, W), 0 for outliers.
    """

    cost: Tensor
    terms: tuple[tuple[Tensor, Tensor, Tensor], tuple[Tensor, Tensor, Tensor]]


def compute_residuals(level: Level, moved: Tensor, gray: Tensor, valid: Tensor, weights: Weights) -> Residuals:
    """Compare moved points with the second frame.

    Args:
        level: its second frame and camera.
        moved: (B, 3, H, W) points after their motion, cm.
        gray, valid: (B, 1, H, W) intensity of the points in the first frame, and 1 where there is a point at all.
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
        # Pixels to -1..1, as `grid_sample` wants them.
        half = max(side - 1, 1e-3) / 2
        torch.addcmul(centre / half - 1, ray, focal / half, out=grid[..., axis])
    there = valid * ((grid[..., 0].abs() <= 1) & (grid[..., 1].abs() <= 1) & (z > 1e-3))
    sampled = functional.grid_sample(level.second, grid, mode="bilinear", padding_mode="border", align_corners=True)
    intensity, iu, iv, depth, zu, zv, has_depth, has_slope = sampled.unbind(1)
    fx_z, fy_z = fx * inverse, fy * inverse

    r_i = intensity - gray
    g_i = _along_point(iu * fx_z, iv * fy_z, ray_x, ray_y)
    cost_i, w_i = _robust(r_i, there, MAX_INTENSITY2, weights.intensity)

    r_z = depth - z
    g_z = _along_point(zu * fx_z, zv * fy_z, ray_x, ray_y)
    g_z[:, 2] -= 1
    # A sample that mixes in one missing pixel is no depth.
    cost_z, w_z = _robust(r_z, there * (has_depth > 0.999), MAX_DEPTH2, weights.depth)
    cost = (cost_i + cost_z) * valid
    return Residuals(cost, ((r_i, g_i, w_i), (r_z, g_z, w_z * (has_slope > 0.999))))


def _along_point(along_x: Tensor, along_y: Tensor, ray_x: Tensor, ray_y: Tensor) -> Tensor:
    """Gradient of an image value at the projection, along the point; `along_x` is its slope along u times fx / z."""
    return torch.stack([along_x, along_y, torch.addcmul(along_x * ray_x, along_y, ray_y).neg_()], dim=1)


def _robust(residual: Tensor, there: Tensor, limit2: float, weight: float) -> tuple[Tensor, Tensor]:
    square = residual * residual
    counts = there * (square < limit2)
    root = square.add_(EPSILON).sqrt_()
    outlier = math.sqrt(limit2 + EPSILON)
    weights = (counts / root).mul_(weight)
    return root.sub_(outlier).mul_(counts).add_(outlier).mul_(weight), weights
