"""Positions of the current pixels in the previous image, and their visibility there."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from objectflow.geometry.torch_pinhole import project
from objectflow.geometry.torch_resample import sampling_grid

_TOLERANCE = (0.01, 0.02)
"""Metres, and share of the depth, by which the previous surface must be nearer to occlude a point. The tolerance is
coarse, since depth is compared at the nearest pixel and changes within one pixel on slanted surfaces."""


def previous_pixels(points: Tensor, flow: Tensor, prev_depth: Tensor, intrinsics: Tensor) -> Tensor:
    """The true pixel matches, as targets for a network.

    Args:
        points: (B, 3, H, W) metres, of the current frame; NaN or z <= 0 where depth is missing.
        flow: (B, 3, H, W) metres, from the current points to the previous ones.
        prev_depth: (B, H, W) metres, 0 where missing.
        intrinsics: (B, 4) fx, fy, cx, cy of both images.

    Returns:
        (B, 2, H, W) column and row in the previous image, with pixel centres at whole numbers; NaN where the current
        depth is missing, and where the point is outside the previous image or occluded there. Missing previous depth
        occludes nothing.
    """
    before = points + flow
    pixel, in_front = project(before, intrinsics)
    height, width = prev_depth.shape[-2:]
    column, row = pixel.unbind(1)
    valid = torch.isfinite(pixel).all(1) & in_front[:, 0] & (points[:, 2] > 0)
    valid &= (column > -0.5) & (column < width - 0.5) & (row > -0.5) & (row < height - 0.5)
    grid = sampling_grid(column, row, height, width)
    grid = torch.where(valid[..., None], grid, torch.zeros_like(grid))
    surface = F.grid_sample(prev_depth[:, None], grid, mode="nearest", align_corners=False)[:, 0]
    absolute, share = _TOLERANCE
    occluded = (surface > 0) & (surface < before[:, 2] * (1 - share) - absolute)
    return torch.where((valid & ~occluded)[:, None], pixel, torch.nan)
