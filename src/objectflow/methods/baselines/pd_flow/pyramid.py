"""Image pyramids of PD-Flow: gray filtered by a 5x5 binomial kernel, depth by the same within one surface."""

from __future__ import annotations

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

LEVELS = 5
_SURFACE = 0.1
"""Largest difference to the centre's depth at which a neighbour has a weight, metres."""
_BINOMIAL = (1.0, 4.0, 6.0, 4.0, 1.0)


class Images(NamedTuple):
    """Frames at one resolution; pixel (u, v) of a level is pixel (2u, 2v) of the next finer level.

    Attributes:
        gray: (B, 1, H, W), 0..255.
        depth: (B, 1, H, W) metres, 0 where missing.
        intrinsics: (B, 4) fx, fy, cx, cy in pixels of this level.
    """

    gray: Tensor
    depth: Tensor
    intrinsics: Tensor


def build_pyramid(images: Images, levels: int = LEVELS) -> list[Images]:
    """Build the levels, finest first; height and width must be multiples of `2 ** (levels - 1)`."""
    out = [images]
    for _ in range(levels - 1):
        fine = out[-1]
        out.append(Images(_halve_gray(fine.gray), _halve_depth(fine.depth), fine.intrinsics / 2))
    return out


def upsample_flow(values: Tensor) -> Tensor:
    """(B, C, H, W) -> (B, C, 2H, 2W): values are placed on even pixels and interpolated by the binomial kernel."""
    kernel = _kernel(values)
    # Normalised by the sum of the weights used, so that constants are preserved at the border.
    return _filter(_insert_zeros(values), kernel) / _filter(_insert_zeros(torch.ones_like(values[:1, :1])), kernel)


def _insert_zeros(values: Tensor) -> Tensor:
    batch, channels, height, width = values.shape
    out = values.new_zeros(batch, channels, height, 2, width, 2)
    out[:, :, :, 0, :, 0] = values
    return out.view(batch, channels, 2 * height, 2 * width)


def _halve_gray(gray: Tensor) -> Tensor:
    kernel = _kernel(gray)
    inside = _filter(torch.ones_like(gray[:1]), kernel)
    return (_filter(gray, kernel) / inside)[..., ::2, ::2]


def _halve_depth(depth: Tensor) -> Tensor:
    """Average each even pixel with neighbours, weighted by similarity in depth; missing even pixels stay missing."""
    batch, _, height, width = depth.shape
    center = depth[..., ::2, ::2].flatten(2)
    block = F.unfold(depth, 5, padding=2, stride=2)
    weight = _kernel(depth).view(1, 25, 1) * (_SURFACE - (block - center).abs()).clamp(min=0) * (block > 0)
    total = weight.sum(1, keepdim=True)
    mean = (weight * block).sum(1, keepdim=True) / total.clamp(min=1e-12)
    return torch.where((center > 0) & (total > 0), mean, 0.0).view(batch, 1, height // 2, width // 2)


def _kernel(like: Tensor) -> Tensor:
    row = torch.tensor(_BINOMIAL, dtype=like.dtype, device=like.device) / 16
    return row[:, None] * row


def _filter(image: Tensor, kernel: Tensor) -> Tensor:
    batch, channels, height, width = image.shape
    out = F.conv2d(image.reshape(batch * channels, 1, height, width), kernel[None, None], padding=2)
    return out.view(image.shape)
