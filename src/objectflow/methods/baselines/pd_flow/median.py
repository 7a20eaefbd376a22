"""The filter between the levels: a 3x3 median whose weights trust the same surface and what did not change."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

_DEPTH, _CHANGE = 5.0, 10.0
"""Per square metre: how fast a neighbour's weight falls with its distance in depth, and with Z_t."""


def weighted_median(flow: Tensor, depth: Tensor, depth_t: Tensor) -> Tensor:
    """Filter every channel of a flow by itself.

    Args:
        flow: (B, C, H, W).
        depth: (B, 1, H, W) metres, 0 where missing; such pixels keep their flow.
        depth_t: (B, 1, H, W) metres: the second frame's depth less the first's.

    Returns:
        (B, C, H, W). A median falls between two values by how near each comes to half of the weight.
    """
    batch, channels, height, width = flow.shape
    near, change, inside = (
        F.unfold(image, 3, padding=1).view(batch, 9, height, width)
        for image in (depth, depth_t, torch.ones_like(depth))
    )
    weight = inside / (1 + _DEPTH * (near - depth).square() + _CHANGE * change.square())
    values = F.unfold(flow, 3, padding=1).view(batch, channels, 9, height, width)
    # Neighbours outside the image sort last, where their weight of 0 reaches nothing.
    values = torch.where(inside[:, None] > 0, values, torch.inf)
    values, order = values.sort(2)
    reached = weight[:, None].expand_as(values).gather(2, order).cumsum(2)
    half = reached[:, :, -1:] / 2
    right = (reached < half).sum(2, keepdim=True)
    left = (right - 1).clamp(min=0)
    low, high = values.gather(2, left), values.gather(2, right)
    low_reached, high_reached = reached.gather(2, left), reached.gather(2, right)
    share = torch.where(right > 0, (half - low_reached) / (high_reached - low_reached).clamp(min=1e-12), 1.0)
    filtered = (low + share * (high - low))[:, :, 0]
    return torch.where(depth > 0, filtered, flow)
