"""The XYZ encoder with masked convolutions: pixels without depth are left out of every sum (Liu et al., ECCV 2018)."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from objectflow.networks.sceneflownet.settings import Stages


class MaskedConv2d(nn.Conv2d):
    """A convolution over known pixels: the sum is scaled up by how many of the window's are known ("partial")."""

    def masked(self, x: Tensor, known: Tensor) -> tuple[Tensor, Tensor]:
        """(B, C, H, W), 0 where unknown, and (B, 1, H, W) of 1 and 0 -> the same of the output; unknown stays 0."""
        size, stride, padding = self.kernel_size, self.stride, self.padding
        share = F.avg_pool2d(known, size, stride, padding if isinstance(padding, tuple) else 0)
        some = (share > 0).to(x.dtype)
        out = F.conv2d(x, self.weight, None, stride, padding) / torch.where(share > 0, share, 1.0)
        if self.bias is not None:
            out = out + self.bias.view(1, -1, 1, 1)
        return out * some, some


class MaskedShapeEncoder(nn.ModuleList):
    """The VGG of `backbone.shape_encoder` with masked convolutions and one input less: validity is no channel.

    (B, 4, H, W) points, 0 where unknown, and validity -> (B, C, H / 8, W / 8), 0 where a cell saw no depth at all.
    """

    def __init__(self, stages: Stages) -> None:
        layers, inputs = [], 3
        for stage in stages:
            for i, width in enumerate(stage):
                layers.append(MaskedConv2d(inputs, width, 3, 2 if i == len(stage) - 1 else 1, 1))
                inputs = width
        super().__init__(layers)

    def forward(self, shape: Tensor) -> Tensor:
        """The encoder."""
        x, known = shape[:, :3], shape[:, 3:]
        for layer in self:
            assert isinstance(layer, MaskedConv2d)
            x, known = layer.masked(x, known)
            x = torch.relu(x)
        return x
