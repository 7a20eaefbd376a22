"""The three levels of SR-Flow: smoothed intensity, filtered depth and, for the second image, their slopes.

Lengths are centimetres here and in the rest of the method, because its weights are for centimetres.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch
from torch import Tensor
from torch.nn import functional

from objectflow.geometry import torch_pinhole

CENTIMETRES = 100.0
MEDIAN_SIDES = (5, 3, 3)
"""Median filters on depth, one after the other."""

MIN_SIDE = 12
"""A level smaller than this would be mostly border for 5x5 windows."""


@dataclass(frozen=True, eq=False)
class Level:
    """Two frames at one resolution, batch first.

    Attributes:
        gray: (B, 1, H, W) intensity of the first frame, 0..1.
        points: (B, 3, H, W) its points in cm; 0 where depth is missing.
        valid: (B, 1, H, W) float, 1 where it has depth.
        second: (B, 8, H, W) of the second frame: intensity and its slopes along u and v, depth in cm and its slopes,
            and two masks (1 or 0): depth is there, and with it its slopes.
        intrinsics: (B, 4) `fx, fy, cx, cy` in pixels of this level.
        pivot: (B, 3, 1, 1) cm: the point that twists turn about, the mean of the first frame's finest points. About
            the camera's centre instead, an object's turn in place would be a long translation as well, and a step to
            the side could pass for a rotation.
    """

    gray: Tensor
    points: Tensor
    valid: Tensor
    second: Tensor
    intrinsics: Tensor
    pivot: Tensor

    def item(self, index: int) -> Level:
        """One pair of the batch, as a batch of one."""
        return Level(**{field.name: getattr(self, field.name)[index, None] for field in fields(self)})


def build_pyramid(
    first: tuple[Tensor, Tensor], second: tuple[Tensor, Tensor], intrinsics: Tensor, levels: int
) -> list[Level]:
    """Make the levels, finest first; fewer than asked for where the images are too small.

    Args:
        first, second: colour (B, 3, H, W) in 0..1 and depth (B, 1, H, W) in metres, 0 = missing.
        intrinsics: (B, 4) pixels, of these images.
        levels: how many at most.
    """
    grays = [_smooth(_gray(color)) for color, _ in (first, second)]
    depths = [_median(depth * CENTIMETRES) for _, depth in (first, second)]
    points, there = torch_pinhole.back_project(depths[0], intrinsics), depths[0] > 0
    pivot = points.sum((2, 3), keepdim=True) / there.sum((2, 3), keepdim=True).clamp(min=1)
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
    there = (depth > 0).to(depth.dtype)
    # A slope needs its whole 3x3 neighbourhood: one missing value would look like a cliff.
    around = -functional.max_pool2d(functional.pad(-there, (1, 1, 1, 1), mode="replicate"), 3, stride=1)
    second = torch.cat([grays[1], _slopes(grays[1]), depth, _slopes(depth) * around, there, around], dim=1)
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
    """3x3 Gaussian of standard deviation 1 pixel."""
    row = torch.exp(-torch.tensor([1.0, 0.0, 1.0], dtype=image.dtype, device=image.device) / 2)
    kernel = row[:, None] * row
    return functional.conv2d(
        functional.pad(image, (1, 1, 1, 1), mode="replicate"), (kernel / kernel.sum())[None, None]
    )


def _slopes(image: Tensor) -> Tensor:
    """Sobel, scaled to a change a pixel: (B, 1, H, W) -> (B, 2, H, W), along u and along v."""
    kernel = torch.tensor([[-1.0, 0, 1], [-2, 0, 2], [-1, 0, 1]], dtype=image.dtype, device=image.device) / 8
    return functional.conv2d(
        functional.pad(image, (1, 1, 1, 1), mode="replicate"), torch.stack([kernel, kernel.T])[:, None]
    )


def _median(depth: Tensor) -> Tensor:
    """Medians of what was measured around each measured pixel; a missing one stays missing."""
    for side in MEDIAN_SIDES:
        half = side // 2
        windows = functional.unfold(functional.pad(depth, (half,) * 4, mode="replicate"), side).view(
            len(depth), side**2, *depth.shape[2:]
        )
        windows = torch.where(windows > 0, windows, torch.nan)
        depth = torch.where(depth > 0, windows.nanmedian(1, keepdim=True).values, 0.0)
    return depth


def _scaled(intrinsics: Tensor, along_u: float, along_v: float) -> Tensor:
    """Intrinsics of a smaller image; pixel centres are whole, so that the corner is at -0.5."""
    fx, fy, cx, cy = intrinsics.unbind(1)
    return torch.stack([fx * along_u, fy * along_v, (cx + 0.5) * along_u - 0.5, (cy + 0.5) * along_v - 0.5], dim=1)
