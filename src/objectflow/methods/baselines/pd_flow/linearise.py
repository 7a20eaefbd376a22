"""Linearisation of one level's energy: derivatives of the warped second frame, and the metric of the surface."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from objectflow.geometry import torch_pinhole
from objectflow.geometry.torch_resample import (
    bilinear_corners,
    bilinear_weights,
    interpolate_corners,
    sample_bilinear,
    take_pixels,
)
from objectflow.methods.baselines.pd_flow.pyramid import Images

MU, MU_SLOPE = 75.0, 1000.0
"""Weight of depth relative to brightness (0..255), and its decrease with large derivatives."""


class Level(NamedTuple):
    """Coefficients of a level's energy; every tensor is (B, C, H, W).

    Attributes:
        gray: 3 channels: derivatives along u and v, and the second frame minus the first.
        depth: the same for depth, metres.
        mu: 1 channel: weight of the depth term.
        metric: 2 channels: r along u and v, which converts differences of neighbours to slopes on the surface.
        warp: 2 channels: the flow (u, v) by which the second frame was warped, pixels.
    """

    gray: Tensor
    depth: Tensor
    mu: Tensor
    metric: Tensor
    warp: Tensor


def linearise(first: Images, second: Images, warp: Tensor) -> Level:
    """Compute the derivatives of the second frame, warped to the first by the flow `warp` (B, 2, H, W) in pixels.

    A derivative is the mean of the differences to both sides, weighted by the second frame's metric, so that pixels
    beside an edge take the slope of their own side.
    """
    height, width = first.depth.shape[2:]
    second_metric = _metric(second)
    valid = second.depth > 0
    slopes = [
        *(_slope(second.gray, second_metric, axis) for axis in (0, 1)),
        *(torch.where(valid, _slope(second.depth, second_metric, axis), 0.0) for axis in (0, 1)),
    ]
    u = (torch.arange(width, device=warp.device) + warp[:, 0]).clamp(0, width - 1)
    v = (torch.arange(height, device=warp.device)[:, None] + warp[:, 1]).clamp(0, height - 1)
    sampled = sample_bilinear(torch.cat([*slopes, second.gray], 1), u, v)
    gray_u, gray_v, depth_u, depth_v, gray = (sampled[:, k : k + 1] for k in range(5))
    depth = _sample_depth(second.depth, u, v)
    depth_t = torch.where(depth > 0, depth - first.depth, 0.0)
    mu = MU / (1 + MU_SLOPE * (depth_u.square() + depth_v.square() + depth_t.square()))
    return Level(
        gray=torch.cat([gray_u, gray_v, gray - first.gray], 1),
        depth=torch.cat([depth_u, depth_v, depth_t], 1),
        mu=mu,
        metric=_metric(first),
        warp=warp,
    )


def _metric(images: Images) -> Tensor:
    """Metric r = 2 / |step to the next surface point| along u and v, (B, 2, H, W) in 1/m; 1 where the step is 0."""
    points = torch_pinhole.back_project(images.depth, images.intrinsics)
    out = points.new_ones(len(points), 2, *points.shape[2:])
    for axis, coordinate, inner in ((0, 0, out[:, 0, :, :-1]), (1, 1, out[:, 1, :-1])):
        step = points.diff(dim=3 - axis)[:, [coordinate, 2]].norm(dim=1)
        inner.copy_(torch.where(step > 0, 2 / step.clamp(min=1e-12), 1.0))
    return out


def _slope(image: Tensor, metric: Tensor, axis: int) -> Tensor:
    """Derivative along u (axis 0) or v (axis 1), one-sided on the border."""
    dim = 3 - axis
    step = image.diff(dim=dim)
    r = metric[:, axis : axis + 1].narrow(dim, 0, step.shape[dim])
    count = step.shape[dim] - 1
    left, right = (step.narrow(dim, k, count) for k in (0, 1))
    r_left, r_right = (r.narrow(dim, k, count) for k in (0, 1))
    middle = (r_right * right + r_left * left) / (r_right + r_left)
    return torch.cat([step.narrow(dim, 0, 1), middle, step.narrow(dim, count, 1)], dim)


def _sample_depth(depth: Tensor, u: Tensor, v: Tensor) -> Tensor:
    """Bilinear depth, or that of the nearest pixel where a neighbour with positive weight is missing."""
    index, du, dv = bilinear_corners(u, v, *depth.shape[2:])
    corners, weights = take_pixels(depth, index), bilinear_weights(du, dv)
    nearest = (v.round() * depth.shape[3] + u.round()).long()[:, None]
    complete = ((corners > 0) | ~(weights[:, None] > 0)).all(2)
    return torch.where(complete, interpolate_corners(corners, weights), take_pixels(depth, nearest)[:, :, 0])
