"""Features for the correlation with context, beyond the reach of the paper's trunk."""

from __future__ import annotations

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
