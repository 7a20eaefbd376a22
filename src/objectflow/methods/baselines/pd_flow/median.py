"""The filter between levels: a 3x3 weighted median that favours the same surface and constant depth."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

_DEPTH, _CHANGE = 5.0, 10.0
"""Decrease of a neighbour's weight with its squared depth difference and with Z_t^2, 1/m^2."""


def weighted_median(flow: Tensor, depth: Tensor, depth_t: Tensor) -> Tensor:
    """Filter each channel of a flow.

    Args:
        flow: (B, C, H, W).
        depth: (B, 1, H, W) metres, 0 where missing; such pixels keep their flow.
        depth_t: (B, 1, H, W) metres: the second frame's depth minus the first's.

    Returns:
        (B, C, H, W) medians, interpolated between the two values whose cumulative weights enclose half of the total.
    """
    batch, channels, height, width = flow.shape
    neighbour, change, inside = (
        F.unfold(image, 3, padding=1).view(batch, 9, height, width)
        for image in (depth, depth_t, torch.ones_like(depth))
    )
    weight = inside / (1 + _DEPTH * (neighbour - depth).square() + _CHANGE * change.square())
    values = F.unfold(flow, 3, padding=1).view(batch, channels, 9, height, width)
    # Neighbours outside the image sort last, where their weight of 0 has no effect.
    values = torch.where(inside[:, None] > 0, values, torch.inf)
    values, order = values.sort(2)
    cumulative = weight[:, None].expand_as(values).gather(2, order).cumsum(2)
    half = cumulative[:, :, -1:] / 2
    right = (cumulative < half).sum(2, keepdim=True)
    left = (right - 1).clamp(min=0)
    low, high = values.gather(2, left), values.gather(2, right)
    low_weight, high_weight = cumulative.gather(2, left), cumulative.gather(2, right)
    share = torch.where(right > 0, (half - low_weight) / (high_weight - low_weight).clamp(min=1e-12), 1.0)
    filtered = (low + share * (high - low))[:, :, 0]
    return torch.where(depth > 0, filtered, flow)
