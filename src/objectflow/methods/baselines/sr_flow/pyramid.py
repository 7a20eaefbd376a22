"""The pyramid of SR-Flow: smoothed intensity, filtered depth and, for the second frame, their gradients.

Lengths are in centimetres in the whole method, because its weights are for centimetres.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch
from torch import Tensor
from torch.nn import functional

from objectflow.geometry import torch_pinhole

CENTIMETRES = 100.0
MEDIAN_SIDES = (5, 3, 3)
"""Sizes of the consecutive median filters on depth, pixels."""

MIN_SIDE = 12
"""Minimum height and width of a level, pixels; 5x5 windows on smaller levels would mostly cross the border."""


@dataclass(frozen=True, eq=False)
class Level:
    """Two frames at one resolution, batch first.

    Attributes:
        gray: (B, 1, H, W) intensity of the first frame, 0..1.
        points: (B, 3, H, W) its points in cm; 0 where depth is missing.
        valid: (B, 1, H, W) float, 1 where it has depth.
        second: (B, 8, H, W) of the second frame: intensity and its gradient along u and v, depth in cm and its
            gradient, and two masks (1 or 0): whether depth and its gradient are known.
        intrinsics: (B, 4) `fx, fy, cx, cy` in pixels of this level.
        pivot: (B, 3, 1, 1) cm, the mean of the first frame's points, about which twists rotate. With the camera's
            centre as the pivot, rotations in place would imply large translations, and lateral translations could be
            explained by rotations.
    """

    gray: Tensor
    points: Tensor
    valid: Tensor
    second: Tensor
    intrinsics: Tensor
    pivot: Tensor

    def item(self, index: int) -> Level:
        """One pair of the batch, as a batch of size 1."""
        return Level(**{field.name: getattr(self, field.name)[index, None] for field in fields(self)})


def build_pyramid(
    first: tuple[Tensor, Tensor], second: tuple[Tensor, Tensor], intrinsics: Tensor, levels: int
) -> list[Level]:
    """Build the levels, finest first.

    Args:
        first, second: colour (B, 3, H, W) in 0..1 and depth (B, 1, H, W) in metres, 0 = missing.
        intrinsics: (B, 4) pixels, of these images.
        levels: maximum number; small images have fewer.
    """
    grays = [_smooth(_gray(color)) for color, _ in (first, second)]
    depths = [_median(depth * CENTIMETRES) for _, depth in (first, second)]
    points, valid = torch_pinhole.back_project(depths[0], intrinsics), depths[0] > 0
    pivot = points.sum((2, 3), keepdim=True) / valid.sum((2, 3), keepdim=True).clamp(min=1)
    out = [_level(grays, depths, intrinsics, pivot)]
    while len(out) < levels and min(depths[0].shape[2:]) // 2 >= MIN_SIDE:
        size = [side // 2 for side in depths[0].shape[2:]]
        scale = [new / old for new, old in zip(size, depths[0].shape[2:], strict=True)]
        grays = [functional.interpolate(gray, size, mode="bilinear", antialias=True) for gray in grays]
        depths = [functional.interpolate(depth, size, mode="nearest-exact") for depth in depths]
        intrinsics = _scaled(intrinsics, scale[1], scale[0])
        out.append(_level(grays, depths, intrinsics, pivot))
    return out


def _level(grays: list[Tensor], depths: list[Tensor], intrinsics: Tensor, pivot: Tensor) -> Level:
    depth = depths[1]
    valid = (depth > 0).to(depth.dtype)
    # A gradient needs its whole 3x3 neighbourhood, since a missing depth of 0 would cause a large gradient.
    valid_gradient = -functional.max_pool2d(functional.pad(-valid, (1, 1, 1, 1), mode="replicate"), 3, stride=1)
    depth_gradient = _gradient(depth) * valid_gradient
    second = torch.cat([grays[1], _gradient(grays[1]), depth, depth_gradient, valid, valid_gradient], dim=1)
    return Level(
        gray=grays[0],
        points=torch_pinhole.back_project(depths[0], intrinsics),
        valid=(depths[0] > 0).to(depth.dtype),
        second=second,
        intrinsics=intrinsics,
        pivot=pivot,
    )


def _gray(color: Tensor) -> Tensor:
    return (color * color.new_tensor([0.299, 0.587, 0.114]).view(1, 3, 1, 1)).sum(1, keepdim=True)


def _smooth(image: Tensor) -> Tensor:
    """Filter with a 3x3 Gaussian of standard deviation 1 pixel."""
    row = torch.exp(-torch.tensor([1.0, 0.0, 1.0], dtype=image.dtype, device=image.device) / 2)
    kernel = row[:, None] * row
    return functional.conv2d(
        functional.pad(image, (1, 1, 1, 1), mode="replicate"), (kernel / kernel.sum())[None, None]
    )


def _gradient(image: Tensor) -> Tensor:
    """Sobel gradient along u and v per pixel: (B, 1, H, W) -> (B, 2, H, W)."""
    kernel = torch.tensor([[-1.0, 0, 1], [-2, 0, 2], [-1, 0, 1]], dtype=image.dtype, device=image.device) / 8
    return functional.conv2d(
        functional.pad(image, (1, 1, 1, 1), mode="replicate"), torch.stack([kernel, kernel.T])[:, None]
    )


def _median(depth: Tensor) -> Tensor:
    """Median of the valid depths around each valid pixel; missing pixels stay missing."""
    for side in MEDIAN_SIDES:
        half = side // 2
        windows = functional.unfold(functional.pad(depth, (half,) * 4, mode="replicate"), side).view(
            len(depth), side**2, *depth.shape[2:]
        )
        windows = torch.where(windows > 0, windows, torch.nan)
        depth = torch.where(depth > 0, windows.nanmedian(1, keepdim=True).values, 0.0)
    return depth


def _scaled(intrinsics: Tensor, along_u: float, along_v: float) -> Tensor:
    """Intrinsics of a smaller image; pixel centres are integers, so the image corner is at -0.5."""
    fx, fy, cx, cy = intrinsics.unbind(1)
    return torch.stack([fx * along_u, fy * along_v, (cx + 0.5) * along_u - 0.5, (cy + 0.5) * along_v - 0.5], dim=1)
