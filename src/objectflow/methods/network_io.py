"""Frames as tensors at the size that a network was trained at."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from objectflow import geometry
from objectflow.errors import MethodError
from objectflow.frame import RgbdFrame

PAPER_SIZE = (240, 320)
"""Height and width that weights without a size of their own are taken to be trained at."""


MAX_BATCH = 16
"""Maximum number of pairs that a network is given at once."""


class SizeGroup(NamedTuple):
    """Pairs of one size: (H, W) and their indices."""

    size: tuple[int, int]
    members: tuple[int, ...]


def scaled_size(frame: RgbdFrame, size: tuple[int, int]) -> tuple[int, int]:
    """(H, W) of the frame's aspect ratio with about as many pixels as `size` (H, W)."""
    height, width = frame.depth.shape
    scale = math.sqrt(size[0] * size[1] / (height * width))
    return max(1, round(height * scale)), max(1, round(width * scale))


def same_size_groups(sizes: Sequence[tuple[int, int]]) -> list[SizeGroup]:
    """Indices of equal sizes, in groups of at most `MAX_BATCH`."""
    members: dict[tuple[int, int], list[int]] = {}
    for index, size in enumerate(sizes):
        members.setdefault(size, []).append(index)
    return [
        SizeGroup(size, tuple(found[start : start + MAX_BATCH]))
        for size, found in members.items()
        for start in range(0, len(found), MAX_BATCH)
    ]


def to_tensors(frames: Sequence[RgbdFrame], device: torch.device) -> tuple[Tensor, Tensor]:
    """Colour in 0..1 and points in metres, (B, 3, H, W) each, of frames of one size."""
    color = torch.stack([torch.from_numpy(frame.color) for frame in frames]).to(device).float() / 255
    points = torch.stack([torch.from_numpy(geometry.back_project(f.depth, f.camera)) for f in frames]).to(device)
    # Permuted channels are channels last without a copy.
    return color.permute(0, 3, 1, 2), points.permute(0, 3, 1, 2)


def trained_size(metadata: dict[str, Any], path: Path) -> tuple[int, int]:
    """(H, W) that weights were trained at, from their metadata.

    Raises:
        MethodError: a size that is none; the message starts with `path`.
    """
    size = metadata.get("size", PAPER_SIZE)
    try:
        height, width = (int(one) for one in size)
    except (TypeError, ValueError):
        raise MethodError(f"{path}: damaged: its size must be [height, width], not {size!r}") from None
    if min(height, width) < 8:
        raise MethodError(f"{path}: damaged: its size must be at least 8x8, not {size!r}")
    return height, width
