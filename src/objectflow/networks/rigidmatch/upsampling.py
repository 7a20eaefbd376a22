"""Convex upsampling from a coarse grid to a finer one (Teed and Deng 2020)."""

from __future__ import annotations

import math

import torch
from torch import Tensor


def mix_neighbors(values: Tensor, weights: Tensor) -> Tensor:
    """Each fine value as a weighted mean of 3x3 coarse ones.

    Args:
        values: (B, C, h, w).
        weights: (B, 9, S, h, w), which sum to 1 over the second axis, for S = f^2 sub-cells, row first.

    Returns:
        (B, C, f h, f w).
    """
    batch, channels, height, width = values.shape
    factor = math.isqrt(weights.shape[2])
    # Not by F.pad, whose gradient torch.compile cannot follow where channels are innermost.
    wide = torch.cat([values[..., :1], values, values[..., -1:]], dim=-1)
    padded = torch.cat([wide[..., :1, :], wide, wide[..., -1:, :]], dim=-2)
    out = torch.zeros((), device=values.device, dtype=values.dtype)
    for k in range(9):
        row, column = divmod(k, 3)
        neighbor = padded[..., row : row + height, column : column + width]
        out = out + neighbor[:, :, None] * weights[:, k][:, None]
    out = out.reshape(batch, channels, factor, factor, height, width)
    return out.permute(0, 1, 4, 2, 5, 3).reshape(batch, channels, factor * height, factor * width)
