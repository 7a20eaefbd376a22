"""Input channels of the encoder (colour, inverse depth, validity, normals) and points of the feature grids."""

from __future__ import annotations

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from objectflow.networks.sceneflownet.network import fill_holes

CHANNELS = 8
_NEAR = 0.1
"""Minimum depth in metres; inverse depth is clamped below it."""


class Grid(NamedTuple):
    """Points of a grid's cells.

    Attributes:
        points: (B, 3, h, w) metres; the mean of the nearest points where depth is missing.
        valid: (B, 1, h, w) 1 where depth is valid, else 0.
    """

    points: Tensor
    valid: Tensor


def encode_inputs(color: Tensor, points: Tensor, multiple: int) -> tuple[Tensor, Tensor, Tensor]:
    """Compute the encoder's eight input channels and the points of a frame.

    Args:
        color: (B, 3, H, W) RGB in 0..1.
        points: (B, 3, H, W) metres, NaN where depth is missing.
        multiple: images are padded with zeros at the right and bottom to a multiple of this size in pixels.

    Returns:
        (B, 8, H', W') channels; (B, 3, H', W') points, 0 where depth is missing; (B, 1, H', W') validity.
    """
    safe, valid = clean_points(points)
    inverse = valid / safe[:, 2:].clamp_min(_NEAR)
    image = torch.cat([(color - 0.45) / 0.25, inverse, valid, normals(safe, valid)], dim=1)
    height, width = color.shape[-2:]
    pad = (0, -width % multiple, 0, -height % multiple)
    return F.pad(image, pad), F.pad(safe, pad), F.pad(valid, pad)


def clean_points(points: Tensor) -> tuple[Tensor, Tensor]:
    """(B, 3, H, W) points with NaN -> points with 0 instead, and (B, 1, H, W) validity: 1 with depth > 0, else 0."""
    finite = torch.isfinite(points).all(dim=1, keepdim=True)
    safe = torch.where(finite, points, torch.zeros_like(points))
    return safe, (safe[:, 2:] > 0).to(points.dtype)


def normals(points: Tensor, valid: Tensor) -> Tensor:
    """Compute unit normals toward the camera by central differences; 0 at borders and missing neighbours.

    Args:
        points: (B, 3, H, W) metres.
        valid: (B, 1, H, W) 1 or 0.
    """
    across = points[..., 1:-1, 2:] - points[..., 1:-1, :-2]
    down = points[..., 2:, 1:-1] - points[..., :-2, 1:-1]
    both = valid[..., 1:-1, 2:] * valid[..., 1:-1, :-2] * valid[..., 2:, 1:-1] * valid[..., :-2, 1:-1]
    (a, b, c), (d, e, f) = down.unbind(1), across.unbind(1)
    normal = torch.stack([b * f - c * e, c * d - a * f, a * e - b * d], dim=1)
    normal = both * normal / normal.square().sum(1, keepdim=True).clamp_min(1e-24).sqrt()
    return F.pad(normal, (1, 1, 1, 1))


def grid(points: Tensor, valid: Tensor, stride: int) -> Grid:
    """Sample the point of every `stride`-th pixel, since means over cells would lie between surfaces."""
    sampled, present = points[..., ::stride, ::stride], valid[..., ::stride, ::stride]
    return Grid(fill_holes(sampled, present), present)


def as_map(tokens: Tensor, size: tuple[int, int]) -> Tensor:
    """(B, h w, C) -> (B, C, h, w)."""
    return tokens.transpose(-2, -1).reshape(tokens.shape[0], tokens.shape[2], *size)


def cells(height: int, width: int, device: torch.device) -> Tensor:
    """Column and row of every cell: (2, h, w) float32."""
    row, column = torch.meshgrid(
        torch.arange(height, device=device, dtype=torch.float32),
        torch.arange(width, device=device, dtype=torch.float32),
        indexing="ij",
    )
    return torch.stack([column, row])
