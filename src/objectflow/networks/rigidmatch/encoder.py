"""Image encoder shared by both frames: ResNet-18 (He et al. 2016) without its last stage, with two output grids."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from objectflow.networks.rigidmatch.inputs import CHANNELS
from objectflow.networks.rigidmatch.settings import RigidMatchSettings


class Block(nn.Module):
    """Two 3x3 layers with a shortcut; (B, inputs, H, W) -> (B, outputs, H / stride, W / stride)."""

    def __init__(self, inputs: int, outputs: int, stride: int = 1) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(inputs, outputs, 3, stride, 1, bias=False)
        self.norm1 = nn.BatchNorm2d(outputs)
        self.conv2 = nn.Conv2d(outputs, outputs, 3, 1, 1, bias=False)
        self.norm2 = nn.BatchNorm2d(outputs)
        self.shortcut: nn.Module = nn.Identity()
        if stride != 1 or inputs != outputs:
            self.shortcut = nn.Sequential(nn.Conv2d(inputs, outputs, 1, stride, bias=False), nn.BatchNorm2d(outputs))

    def forward(self, x: Tensor) -> Tensor:
        """Apply the block."""
        out = torch.relu(self.norm1(self.conv1(x)))
        return torch.relu(self.norm2(self.conv2(out)) + self.shortcut(x))


def stage(inputs: int, outputs: int, blocks: int, stride: int) -> nn.Sequential:
    """Build a sequence of blocks; only the first is strided."""
    return nn.Sequential(Block(inputs, outputs, stride), *(Block(outputs, outputs) for _ in range(blocks - 1)))


class Encoder(nn.Module):
    """(B, 8, H, W) from `encode_inputs` -> features of the stem, the fine grid and the coarse grid."""

    def __init__(self, settings: RigidMatchSettings) -> None:
        super().__init__()
        width, fine, coarse = settings.stem_width, settings.fine_channels, settings.channels
        self.stem = nn.Sequential(
            nn.Conv2d(CHANNELS, width, 5, 2, 2, bias=False), nn.BatchNorm2d(width), nn.ReLU(inplace=True)
        )
        self.fine = stage(width, fine, settings.blocks[0], settings.fine_stride // 2)
        self.coarse = stage(fine, coarse, settings.blocks[1], 2)
        self.context = stage(coarse, 2 * coarse, settings.blocks[2], 2)
        self.lateral = nn.Conv2d(2 * coarse, coarse, 1)

    def forward(self, image: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return (B, stem_width, H / 2, W / 2) and, for the fine and the coarse stride s, (B, C, H / s, W / s)."""
        stem = self.stem(image)
        fine = self.fine(stem)
        coarse = self.coarse(fine)
        # Context is added from a grid of half the resolution, as in feature pyramids (Lin et al. 2017).
        around = F.interpolate(self.lateral(self.context(coarse)), scale_factor=2.0, mode="nearest")
        return stem, fine, coarse + around[..., : coarse.shape[-2], : coarse.shape[-1]]
