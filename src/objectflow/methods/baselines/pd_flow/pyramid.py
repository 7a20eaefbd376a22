"""Image pyramids of PD-Flow: gray by a 5x5 binomial mask, depth by the same on one surface only."""

from __future__ import annotations

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

LEVELS = 5
_SURFACE = 0.1
"""Metres: depth further than this from the block's own does not count."""
_BINOMIAL = (1.0, 4.0, 6.0, 4.0, 1.0)


class Images(NamedTuple):
    """Frames at one resolution: pixel (u, v) of a level is pixel (2u, 2v) of the next finer one.

    Attributes:
        gray: (B, 1, H, W), 0..255.
        depth: (B, 1, H, W) metres, 0 where missing.
        intrinsics: (B, 4) fx, fy, cx, cy in pixels of this level.
    """

    gray: Tensor
    depth: Tensor
    intrinsics: Tensor


def build_pyramid(images: Images, levels: int = LEVELS) -> list[Images]:
    """The levels of both sides a multiple of `2 ** (levels - 1)`, finest first."""
    out = [images]
    for _ in range(levels - 1):
        fine = out[-1]
        out.append(Images(_halve_gray(fine.gray), _halve_depth(fine.depth), fine.intrinsics / 2))
    return out


def upsample_flow(values: Tensor) -> Tensor:
    """(B, C, H, W) -> (B, C, 2H, 2W): values go to the even pixels, the binomial mask fills those between."""
    mask = _mask(values)
    # Divided by the weight of what there is: near the border, too, a constant stays what it is.
    return _filter(_spread(values), mask) / _filter(_spread(torch.ones_like(values[:1, :1])), mask)


def _spread(values: Tensor) -> Tensor:
    batch, channels, height, width = values.shape
    out = values.new_zeros(batch, channels, height, 2, width, 2)
    out[:, :, :, 0, :, 0] = values
    return out.view(batch, channels, 2 * height, 2 * width)


def _halve_gray(gray: Tensor) -> Tensor:
    mask = _mask(gray)
    inside = _filter(torch.ones_like(gray[:1]), mask)
    return (_filter(gray, mask) / inside)[..., ::2, ::2]


def _halve_depth(depth: Tensor) -> Tensor:
    """Weights fall with the distance in depth from the pixel that is kept; what it does not see stays missing."""
    batch, _, height, width = depth.shape
    own = depth[..., ::2, ::2].flatten(2)
    block = F.unfold(depth, 5, padding=2, stride=2)
    weight = _mask(depth).view(1, 25, 1) * (_SURFACE - (block - own).abs()).clamp(min=0) * (block > 0)
    total = weight.sum(1, keepdim=True)
    mean = (weight * block).sum(1, keepdim=True) / total.clamp(min=1e-12)
    return torch.where((own > 0) & (total > 0), mean, 0.0).view(batch, 1, height // 2, width // 2)


def _mask(like: Tensor) -> Tensor:
    row = torch.tensor(_BINOMIAL, dtype=like.dtype, device=like.device) / 16
    return row[:, None] * row


def _filter(image: Tensor, mask: Tensor) -> Tensor:
    batch, channels, height, width = image.shape
    out = F.conv2d(image.reshape(batch * channels, 1, height, width), mask[None, None], padding=2)
    return out.view(image.shape)
