"""One level's energy: both frames' derivatives where the flow so far puts them, and the surface's metric."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from objectflow.geometry import torch_pinhole
from objectflow.methods.baselines.pd_flow.pyramid import Images

MU, MU_SLOPE = 75.0, 1000.0
"""Weight of depth against brightness (0..255), and how fast large derivatives lower it."""


class Level(NamedTuple):
    """What the energy of a level is made of; every tensor (B, C, H, W).

    Attributes:
        gray: 3 channels: derivatives along u and v, and the second frame's less the first's.
        depth: the same of depth, metres.
        mu: 1 channel: weight of the depth term.
        metric: 2 channels: r along u and v, which turns differences of neighbours into slopes on the surface.
        before: 2 channels: the flow (u, v) that the images were warped by, pixels.
    """

    gray: Tensor
    depth: Tensor
    mu: Tensor
    metric: Tensor
    before: Tensor


def linearise(first: Images, second: Images, before: Tensor) -> Level:
    """Derivatives of the second frame, sampled where `before` (B, 2, H, W), in pixels, takes the first frame's pixels.

    A derivative is the mean of the differences to both sides, weighted by the second frame's metric, so that a pixel
    beside an edge takes the slope of its own side.
    """
    height, width = first.depth.shape[2:]
    own_metric = _metric(second)
    seen = second.depth > 0
    slopes = [
        *(_slope(second.gray, own_metric, axis) for axis in (0, 1)),
        *(torch.where(seen, _slope(second.depth, own_metric, axis), 0.0) for axis in (0, 1)),
    ]
    u = (torch.arange(width, device=before.device) + before[:, 0]).clamp(0, width - 1)
    v = (torch.arange(height, device=before.device)[:, None] + before[:, 1]).clamp(0, height - 1)
    sampled = _bilinear(torch.cat([*slopes, second.gray], 1), u, v)
    gray_u, gray_v, depth_u, depth_v, gray = (sampled[:, k : k + 1] for k in range(5))
    depth = _sample_depth(second.depth, u, v)
    depth_t = torch.where(depth > 0, depth - first.depth, 0.0)
    mu = MU / (1 + MU_SLOPE * (depth_u.square() + depth_v.square() + depth_t.square()))
    return Level(
        gray=torch.cat([gray_u, gray_v, gray - first.gray], 1),
        depth=torch.cat([depth_u, depth_v, depth_t], 1),
        mu=mu,
        metric=_metric(first),
        before=before,
    )


def _metric(images: Images) -> Tensor:
    """The metric r = 2 / |step on the surface to the next pixel| along u and v, (B, 2, H, W) 1/m; 1 without a step."""
    points = torch_pinhole.back_project(images.depth, images.intrinsics)
    out = points.new_ones(len(points), 2, *points.shape[2:])
    for axis, coordinate, inner in ((0, 0, out[:, 0, :, :-1]), (1, 1, out[:, 1, :-1])):
        step = points.diff(dim=3 - axis)[:, [coordinate, 2]].norm(dim=1)
        inner.copy_(torch.where(step > 0, 2 / step.clamp(min=1e-12), 1.0))
    return out


def _slope(image: Tensor, metric: Tensor, axis: int) -> Tensor:
    """Derivative along u (axis 0) or v (1), one-sided on the border."""
    dim = 3 - axis
    step = image.diff(dim=dim)
    r = metric[:, axis : axis + 1].narrow(dim, 0, step.shape[dim])
    count = step.shape[dim] - 1
    left, right = (step.narrow(dim, k, count) for k in (0, 1))
    r_left, r_right = (r.narrow(dim, k, count) for k in (0, 1))
    middle = (r_right * right + r_left * left) / (r_right + r_left)
    return torch.cat([step.narrow(dim, 0, 1), middle, step.narrow(dim, count, 1)], dim)


def _corners(u: Tensor, v: Tensor, shape: torch.Size) -> tuple[Tensor, Tensor, Tensor]:
    """Flat indices (B, 4, H, W) of the four pixels around (u, v), and where between them each point lies."""
    height, width = shape[2:]
    u0, v0 = u.floor().clamp(max=width - 2), v.floor().clamp(max=height - 2)
    base = (v0 * width + u0).long()
    return torch.stack([base, base + 1, base + width, base + width + 1], 1), u - u0, v - v0


def _take(image: Tensor, index: Tensor) -> Tensor:
    """(B, C, H, W) at (B, 4, H, W) flat indices -> (B, C, 4, H, W)."""
    batch, channels = image.shape[:2]
    flat = index.flatten(1)[:, None].expand(-1, channels, -1)
    return image.flatten(2).gather(2, flat).view(batch, channels, *index.shape[1:])


def _mix(corners: Tensor, du: Tensor, dv: Tensor) -> Tensor:
    """(B, C, 4, H, W) and two (B, H, W) -> (B, C, H, W)."""
    weights = torch.stack([(1 - du) * (1 - dv), du * (1 - dv), (1 - du) * dv, du * dv], 1)
    return (corners * weights[:, None]).sum(2)


def _bilinear(image: Tensor, u: Tensor, v: Tensor) -> Tensor:
    index, du, dv = _corners(u, v, image.shape)
    return _mix(_take(image, index), du, dv)


def _sample_depth(depth: Tensor, u: Tensor, v: Tensor) -> Tensor:
    """Bilinear; the nearest pixel's where one of the four that count is missing."""
    index, du, dv = _corners(u, v, depth.shape)
    corners = _take(depth, index)
    nearest = (v.round() * depth.shape[3] + u.round()).long()[:, None]
    counts = torch.stack([(1 - du) * (1 - dv), du * (1 - dv), (1 - du) * dv, du * dv], 1)[:, None] > 0
    whole = ((corners > 0) | ~counts).all(2)
    return torch.where(whole, _mix(corners, du, dv), _take(depth, nearest)[:, :, 0])
