"""Details of masks: the fine grid's features on the stem's grid, joined with the stem's own."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from objectflow.networks.rigidmatch.encoder import Block
from objectflow.networks.rigidmatch.settings import RigidMatchSettings


class DetailDecoder(nn.Module):
    """One step of a U-Net (Ronneberger et al. 2015): features at stride 2, and weights that upsample to them."""

    def __init__(self, settings: RigidMatchSettings) -> None:
        super().__init__()
        width = settings.detail_channels
        self.skip = nn.Conv2d(settings.stem_width, width, 1)
        self.down = nn.Conv2d(settings.fine_channels, width, 1)
        self.block = Block(width, width)
        self.guide = nn.Conv2d(4 * width, 9 * 4, 1)

    def forward(self, stem: Tensor, pixels: Tensor) -> tuple[Tensor, Tensor]:
        """Decode.

        Args:
            stem: (B, C'', 2 H, 2 W).
            pixels: (B, C', H, W) features of the fine grid.

        Returns:
            (B, 36, H, W) logits of upsampling weights, and (B, D, 2 H, 2 W) features.
        """
        below = F.interpolate(self.down(pixels), scale_factor=2.0, mode="nearest")
        details = self.block(torch.relu(self.skip(stem) + below))
        guide: Tensor = self.guide(F.pixel_unshuffle(details, 2))
        return guide.float(), details.float()
