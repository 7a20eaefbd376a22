"""How well the correlation knows each cell's match: a term that the paper does not have."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from objectflow.errors import MethodError

_STRIDE = 8
"""Of the cells: cell (i, j) sees the surroundings of pixel (8 i, 8 j)."""
_FEW = 8
"""Cells of a pair from which on it counts as much as any other."""


def match_loss(correlation: Tensor, matches: Tensor, inside: Tensor) -> Tensor:
    """Cross entropy of the correlation, as logits over its patch (van den Oord et al. 2018).

    The truth is shared among the four cells around the true position, bilinearly. Cells whose match is hidden, out of
    the image or of the patch, are left out: a choice "not there" was tried, and its many cells drowned the rest.

    Args:
        correlation: (B, (2 L + 1)^2, h, w), as `correlate` orders it.
        matches: (B, 2, H, W) column and row in the previous image, NaN for none; h = ceil(H / 8), and w likewise.
        inside: (B, H, W) bool: where to look.

    Raises:
        MethodError: a patch of one cell.

    Returns:
        A scalar: the mean over a pair's cells whose pixel is inside and has a match, then over the pairs, so that
        the mean over machines equals the joint batch. A pair with fewer than 8 such cells counts for less.
    """
    patch, height, width = correlation.shape[1:]
    side = math.isqrt(patch)
    if side < 3:
        raise MethodError("the match loss needs a correlation over neighbours: set network.reach to 1 or more")
    cells = matches[..., ::_STRIDE, ::_STRIDE] / _STRIDE
    there = inside[:, ::_STRIDE, ::_STRIDE]
    column = cells[:, 0] - torch.arange(width, device=cells.device) + side // 2
    row = cells[:, 1] - torch.arange(height, device=cells.device)[:, None] + side // 2
    found = there & (column >= 0) & (column <= side - 1) & (row >= 0) & (row <= side - 1)  # False for NaN
    column, row = (torch.where(found, one, 0.0) for one in (column, row))
    logs = F.log_softmax(correlation, dim=1)
    left, top = column.floor().clamp_max(side - 2), row.floor().clamp_max(side - 2)
    x, y = column - left, row - top
    first = (top * side + left).long()
    total = torch.zeros_like(x)
    for step, share in ((0, (1 - x) * (1 - y)), (1, x * (1 - y)), (side, (1 - x) * y), (side + 1, x * y)):
        total = total - share * logs.gather(1, (first + step)[:, None])[:, 0]
    weight = found.to(total.dtype)
    out: Tensor = ((total * weight).sum(dim=(1, 2)) / weight.sum(dim=(1, 2)).clamp_min(_FEW)).mean()
    return out
