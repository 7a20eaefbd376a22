"""Where each current pixel's point lies in the previous image, and whether it can be seen there."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from objectflow.geometry.torch_pinhole import project

_TOLERANCE = (0.01, 0.02)
"""Metres, and share of the depth, by which the previous surface may lie nearer before it hides a point: coarse, since
depth is compared at the nearest pixel, and slanted surfaces fall off within one."""


def previous_pixels(points: Tensor, flow: Tensor, prev_depth: Tensor, intrinsics: Tensor) -> Tensor:
    """The exact matches that a network should find.

    Args:
        points: (B, 3, H, W) metres, the current frame's points; NaN or z <= 0 where depth is missing.
        flow: (B, 3, H, W) metres, from the current points to where they were.
        prev_depth: (B, H, W) metres, 0 where missing.
        intrinsics: (B, 4) fx, fy, cx, cy of both images.

    Returns:
        (B, 2, H, W) column and row in the previous image, pixel centres at whole numbers; NaN where the current depth
        is missing, and where the point is out of the previous image or hidden there. Missing previous depth hides
        nothing.
    """
    before = points + flow
    pixel, in_front = project(before, intrinsics)
    height, width = prev_depth.shape[-2:]
    column, row = pixel.unbind(1)
    valid = torch.isfinite(pixel).all(1) & in_front[:, 0] & (points[:, 2] > 0)
    valid &= (column > -0.5) & (column < width - 0.5) & (row > -0.5) & (row < height - 0.5)
    grid = torch.stack([2 * (column + 0.5) / width - 1, 2 * (row + 0.5) / height - 1], dim=-1)
    grid = torch.where(valid[..., None], grid, torch.zeros_like(grid))
    surface = F.grid_sample(prev_depth[:, None], grid, mode="nearest", align_corners=False)[:, 0]
    absolute, share = _TOLERANCE
    hidden = (surface > 0) & (surface < before[:, 2] * (1 - share) - absolute)
    return torch.where((valid & ~hidden)[:, None], pixel, torch.nan)
