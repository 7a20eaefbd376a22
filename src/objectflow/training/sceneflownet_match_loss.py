"""The match loss of the correlation in `SceneFlowNet`, a term that the paper does not have."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from objectflow.errors import MethodError

_STRIDE = 8
"""Pixels per cell: cell (i, j) is centred on pixel (8 i, 8 j)."""
_MIN_CELLS = 8
"""Number of cells from which on a pair has its full weight."""


def match_loss(correlation: Tensor, matches: Tensor, inside: Tensor) -> Tensor:
    """Cross entropy of the correlation, as logits over its patch (van den Oord et al. 2018).

    The target is distributed bilinearly over the four cells around the true position. Cells whose match is occluded,
    outside the image or outside the patch are excluded; with an extra class for them, their large number dominated
    the loss.

    Args:
        correlation: (B, (2 L + 1)^2, h, w), as `correlate` orders it.
        matches: (B, 2, H, W) column and row in the previous image, NaN for none; h = ceil(H / 8), and w likewise.
        inside: (B, H, W) bool: pixels that are evaluated.

    Raises:
        MethodError: a patch of one cell.

    Returns:
        A scalar: the mean over a pair's cells whose pixel is inside and has a match, then over the pairs, so that
        the mean over machines equals the loss of the joint batch. A pair with fewer than 8 such cells has less weight.
    """
    patch, height, width = correlation.shape[1:]
    side = math.isqrt(patch)
    if side < 3:
        raise MethodError("the match loss needs a correlation over neighbours: set model.network.reach to 1 or more")
    cells = matches[..., ::_STRIDE, ::_STRIDE] / _STRIDE
    evaluated = inside[:, ::_STRIDE, ::_STRIDE]
    column = cells[:, 0] - torch.arange(width, device=cells.device) + side // 2
    row = cells[:, 1] - torch.arange(height, device=cells.device)[:, None] + side // 2
    found = evaluated & (column >= 0) & (column <= side - 1) & (row >= 0) & (row <= side - 1)  # False for NaN
    column, row = (torch.where(found, coordinate, 0.0) for coordinate in (column, row))
    logs = F.log_softmax(correlation, dim=1)
    left, top = column.floor().clamp_max(side - 2), row.floor().clamp_max(side - 2)
    x, y = column - left, row - top
    first = (top * side + left).long()
    total = torch.zeros_like(x)
    for step, share in ((0, (1 - x) * (1 - y)), (1, x * (1 - y)), (side, (1 - x) * y), (side + 1, x * y)):
        total = total - share * logs.gather(1, (first + step)[:, None])[:, 0]
    weight = found.to(total.dtype)
    out: Tensor = ((total * weight).sum(dim=(1, 2)) / weight.sum(dim=(1, 2)).clamp_min(_MIN_CELLS)).mean()
    return out
