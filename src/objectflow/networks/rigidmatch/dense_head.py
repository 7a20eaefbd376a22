"""Dense predictions from features and matches: votes for centres, foreground, match confidence."""

from __future__ import annotations

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from objectflow.networks.rigidmatch.details import DetailDecoder
from objectflow.networks.rigidmatch.encoder import Block
from objectflow.networks.rigidmatch.inputs import Grid
from objectflow.networks.rigidmatch.matching import CoarseMatch
from objectflow.networks.rigidmatch.refinement import FineMatch
from objectflow.networks.rigidmatch.settings import RigidMatchSettings

_DECIMETRES = 10.0
"""Decimetres per metre: in decimetres motions are about 1."""
_HEADS = 6 + 3


class DensePredictions(NamedTuple):
    """Of the current frame.

    Attributes:
        tokens: (B, C, h, w) features of the coarse grid.
        pixels: (B, C', H, W) features of the fine grid.
        votes: (B, 6, H, W) metres: [X, X + T].
        match_confidence, foreground, seed: (B, 1, H, W) logits.
        upsampling: (B, 9, f^2, H, W), weights that sum to 1 over the nine neighbours.
        details: (B, D, 2 H, 2 W) features of the stem's grid; (B, 0, H, W) without them.
    """

    tokens: Tensor
    pixels: Tensor
    votes: Tensor
    match_confidence: Tensor
    foreground: Tensor
    seed: Tensor
    upsampling: Tensor
    details: Tensor


class DenseHead(nn.Module):
    """Joins features, matched motion and its confidence on the coarse and then on the fine grid."""

    def __init__(self, settings: RigidMatchSettings) -> None:
        super().__init__()
        fine, coarse = settings.fine_channels, settings.channels
        self.factor = settings.fine_stride // settings.mask_stride
        self.mix = nn.Sequential(
            nn.Conv2d(2 * coarse + 8, coarse, 1, bias=False), nn.BatchNorm2d(coarse), nn.ReLU(inplace=True)
        )
        self.coarse = nn.Sequential(Block(coarse, coarse), Block(coarse, coarse))
        self.down = nn.Conv2d(coarse, fine, 1)
        self.join = nn.Sequential(
            nn.Conv2d(2 * fine + 8, fine, 1, bias=False), nn.BatchNorm2d(fine), nn.ReLU(inplace=True)
        )
        self.fine = Block(fine, fine)
        self.heads = nn.Conv2d(fine, _HEADS, 1)
        self.details = DetailDecoder(settings) if settings.detail_channels else None
        if self.details is None:
            self.guide = nn.Conv2d(fine, 9 * self.factor**2, 1)

    def forward(
        self,
        stem: Tensor,
        fine: Tensor,
        tokens: Tensor,
        coarse: CoarseMatch,
        match: FineMatch,
        grids: tuple[Grid, Grid],
    ) -> DensePredictions:
        """Predict.

        Args:
            stem: (B, C'', ...) features of the current frame at stride 2.
            fine: (B, C', H, W) features of the current frame.
            tokens: (B, C, h, w) of the coarse grid, after attention.
            coarse, match: its matches.
            grids: the current frame's points, coarse and fine.
        """
        size = coarse.shift.shape[-2:]
        dustbin = coarse.dustbin.sigmoid().reshape(-1, 1, *size)
        known = [coarse.shift[:, 2:] * _DECIMETRES, coarse.confidence, dustbin, grids[0].points]
        around = self.coarse(self.mix(torch.cat([tokens, coarse.feature, *known], dim=1)))
        below = F.interpolate(self.down(around), scale_factor=2.0, mode="nearest")
        moved = (match.match - grids[1].points) * _DECIMETRES
        known = [moved, match.confidence, match.peak, grids[1].points]
        pixels = self.fine(self.join(torch.cat([fine, below, *known], dim=1)))
        found = self.heads(pixels).float()
        if self.details is None:
            guide = self.guide(pixels).float()
            details = found[:, :0]
        else:
            guide, details = self.details(stem, pixels)
        # Centres as offsets: from where the pixel is, and from where it was.
        votes = torch.cat([grids[1].points + found[:, :3], match.match + found[:, 3:6]], dim=1)
        return DensePredictions(
            tokens=around,
            pixels=pixels,
            votes=votes,
            match_confidence=found[:, 6:7],
            foreground=found[:, 7:8],
            seed=found[:, 8:9],
            upsampling=guide.reshape(len(guide), 9, self.factor**2, *guide.shape[-2:]).softmax(dim=1),
            details=details,
        )
