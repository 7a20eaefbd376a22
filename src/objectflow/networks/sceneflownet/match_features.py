"""Features for the correlation from colour and shape, with context; the paper correlates features of colour alone."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn


class ContextBlock(nn.Module):
    """A residual block of two 3x3 layers: (B, C, h, w) -> (B, C, h, w). It starts as the identity."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.first = nn.Conv2d(channels, channels, 3, padding=1)
        self.second = nn.Conv2d(channels, channels, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        """The input plus what its surroundings add."""
        out: Tensor = x + self.second(F.relu(self.first(F.relu(x))))
        return out


class MatchFeatures(nn.Module):
    """Unit-length features of one frame's cells, and a prior of the displacement.

    Colour alone tells neither two sides of an object apart nor where they are. Shape and position are added to it, and
    the blocks let each cell take in its surroundings, across the borders of its object.
    """

    def __init__(self, color_channels: int, shape_channels: int, blocks: int, reach: int) -> None:
        """Build the layers.

        Args:
            color_channels, shape_channels: of the inputs; the features have as many channels as the colour's.
            blocks: number of residual blocks.
            reach: of the correlation, in cells.
        """
        super().__init__()
        self.shape = nn.Conv2d(shape_channels + 4, color_channels, 1)
        self.blocks = nn.Sequential(*(ContextBlock(color_channels) for _ in range(blocks)))
        self.prior = nn.Parameter(torch.zeros((2 * reach + 1) ** 2))
        """Logarithm of the relative frequency of each displacement, in the order of `correlate`; learnt."""

    def forward(self, color: Tensor, shape: Tensor, cells: Tensor) -> Tensor:
        """Features at stride 8.

        Args:
            color: (B, color_channels, h, w).
            shape: (B, shape_channels, h, w).
            cells: (B, 4, h, w) points, and 1 where there is a point.
        """
        joined = color + self.shape(torch.cat([shape, cells], dim=1))
        return F.normalize(self.blocks(joined), dim=1)
