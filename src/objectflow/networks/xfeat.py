"""Frozen XFeat features (Potje et al., CVPR 2024): the backbone without keypoints, its normalisation layers folded."""

from __future__ import annotations

import math
from pathlib import Path

import safetensors.torch
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from objectflow.errors import MethodError

CHANNELS = 64
_PIXELS = 640 * 480
"""Frames are enlarged to about this many pixels, since the features are poor on small images."""
_LARGEST_FACTOR = 2.0
"""Maximum enlargement per axis."""
_MULTIPLE = 32
"""Sides of the image are multiples of the coarsest stride."""

_BLOCKS: dict[str, tuple[tuple[int, int, int, int], ...]] = {
    "block1": ((1, 4, 3, 1), (4, 8, 3, 2), (8, 8, 3, 1), (8, 24, 3, 2)),
    "block2": ((24, 24, 3, 1), (24, 24, 3, 1)),
    "block3": ((24, 64, 3, 2), (64, 64, 3, 1), (64, 64, 1, 1)),
    "block4": ((64, 64, 3, 2), (64, 64, 3, 1), (64, 64, 3, 1)),
    "block5": ((64, 128, 3, 2), (128, 128, 3, 1), (128, 128, 3, 1), (128, 64, 1, 1)),
    "fusion": ((64, 64, 3, 1), (64, 64, 3, 1)),
}
"""Inputs, outputs, kernel and stride of each block's layers."""


class FrozenConv(nn.Module):
    """A convolution whose filters are buffers: part of the state dict, never trained."""

    weight: Tensor
    bias: Tensor

    def __init__(self, inputs: int, outputs: int, kernel: int, stride: int = 1) -> None:
        super().__init__()
        self.stride, self.padding = stride, kernel // 2
        self.register_buffer("weight", torch.zeros(outputs, inputs, kernel, kernel))
        self.register_buffer("bias", torch.zeros(outputs))

    def forward(self, x: Tensor) -> Tensor:
        """(B, inputs, H, W) -> (B, outputs, H / stride, W / stride)."""
        return F.conv2d(x, self.weight, self.bias, self.stride, self.padding)


class XFeat(nn.Module):
    """(B, 3, H, W) RGB in 0..1 -> unit descriptors (B, 64, h, w) at an eighth of the enlarged image's size."""

    def __init__(self, generator: torch.Generator | None = None) -> None:
        """Random filters; `load` replaces them with trained ones."""
        super().__init__()
        self.skip = FrozenConv(1, 24, 1)
        for name, layers in _BLOCKS.items():
            self.add_module(name, nn.Sequential(*(FrozenConv(*layer) for layer in layers)))
        self.head = FrozenConv(64, CHANNELS, 1)
        for tensor in self.state_dict().values():
            if tensor.ndim > 1 and not tensor.is_meta:
                tensor.normal_(0, math.sqrt(2 / tensor[0].numel()), generator=generator)

    @torch.no_grad()
    def forward(self, color: Tensor) -> Tensor:
        """Descriptors of an image's cells, centred on them."""
        size = xfeat_size(color.shape[-2], color.shape[-1])
        grey = F.interpolate(color.mean(1, keepdim=True), size, mode="bilinear", align_corners=False)
        with torch.autocast(color.device.type, enabled=False):
            grey = grey.float()
            grey = grey - grey.mean((2, 3), keepdim=True)
            variance = grey.square().mean((2, 3), keepdim=True)  # in a fifth of the time of torch.var_mean
            grey = grey * (variance + 1e-5).rsqrt()
        x1 = self._block("block1", grey) + self.skip(F.avg_pool2d(grey, 4))
        x3 = self._block("block3", self._block("block2", x1))
        x4 = self._block("block4", x3)
        x5 = self._block("block5", x4)
        for below in (x4, x5):
            x3 = x3 + F.interpolate(below, size=x3.shape[-2:], mode="bilinear", align_corners=False)
        return F.normalize(self.head(self._block("fusion", x3)).float(), dim=1)

    def _block(self, name: str, x: Tensor) -> Tensor:
        for layer in self.get_submodule(name).children():
            x = layer(x).relu_()
        return x

    def load(self, path: Path) -> None:
        """Take the filters from a file of `scripts/convert_xfeat.py`.

        Raises:
            MethodError: a file that does not hold exactly these tensors.
        """
        try:
            tensors = safetensors.torch.load_file(path)
            self.load_state_dict(tensors, strict=True)
        except (OSError, ValueError, RuntimeError, safetensors.SafetensorError) as error:
            reason = (str(error).splitlines() or [type(error).__name__])[0]
            raise MethodError(f"{path}: no XFeat weights of scripts/convert_xfeat.py: {reason}") from error


def xfeat_size(height: int, width: int) -> tuple[int, int]:
    """Height and width to which an image is brought for XFeat."""
    factor = min(_LARGEST_FACTOR, math.sqrt(_PIXELS / (int(height) * int(width))))  # tensors while tracing
    rows, columns = (max(1, round(int(side) * factor / _MULTIPLE)) * _MULTIPLE for side in (height, width))
    return rows, columns


def sample_cells(features: Tensor, size: tuple[int, int], stride: int, cells: tuple[int, int]) -> Tensor:
    """Features at the pixels for which a grid's cells stand.

    Args:
        features: (B, C, h, w) that cover an image of `size`.
        size: (H, W) pixels of the image, without padding.
        stride: pixels per cell.
        cells: rows and columns of the grid; cells beyond the image take the feature at its border.

    Returns:
        (B, C, rows, columns).
    """
    row, column = (
        (2 * stride * torch.arange(count, device=features.device, dtype=torch.float32) + 1) / side - 1
        for count, side in zip(cells, size, strict=True)
    )
    place = torch.stack(torch.meshgrid(row, column, indexing="ij")[::-1], dim=-1)
    places = place.expand(len(features), -1, -1, -1)
    return F.grid_sample(features.float(), places, mode="bilinear", padding_mode="border", align_corners=False)
