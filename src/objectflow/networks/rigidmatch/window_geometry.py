"""Scores of a window's cells from their 3D offsets, for matches that correlation alone leaves ambiguous."""

from __future__ import annotations

import torch
from torch import Tensor, nn

_HIDDEN = 16
_DECIMETRES = 10.0
"""Decimetres per metre: in decimetres offsets are about 1."""


class WindowGeometry(nn.Module):
    """A perceptron over correlation and offset from the current match, conditioned on the cell's features."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.context = nn.Conv2d(channels, _HIDDEN, 1)
        self.window = nn.Linear(5, _HIDDEN)
        self.out = nn.Linear(_HIDDEN, 1)

    def forward(self, context: Tensor, logits: Tensor, points: Tensor, match: Tensor) -> Tensor:
        """Logits to add to the correlation's.

        Args:
            context: (B, 16, ...) of N cells, from `self.context`.
            logits: (B, N, S) correlation of each of the window's S cells.
            points: (B, N, S, 3) metres, the previous frame's.
            match: (B, 3, ...) metres, where the match is so far.

        Returns:
            (B, N, S).
        """
        offset = (points - match.detach().flatten(2).transpose(-2, -1)[:, :, None]) * _DECIMETRES
        length = offset.square().sum(-1, keepdim=True).clamp_min(1e-12).sqrt()
        features = torch.cat([offset, length, 0.1 * logits[..., None]], dim=-1).clamp(-20, 20)
        hidden = torch.relu(self.window(features) + context.flatten(2).transpose(-2, -1)[:, :, None])
        out: Tensor = self.out(hidden)[..., 0]
        return out
