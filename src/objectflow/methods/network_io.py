"""Frames as tensors at the size that a network was trained at."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from objectflow import geometry
from objectflow.errors import MethodError
from objectflow.frame import RgbdFrame

PAPER_SIZE = (240, 320)
"""Height and width that weights without a size of their own are taken to be trained at."""


def resize_to(frame: RgbdFrame, size: tuple[int, int]) -> RgbdFrame:
    """The frame in its own proportions with as many pixels as `size` (H, W) has."""
    height, width = frame.depth.shape
    scale = math.sqrt(size[0] * size[1] / (height * width))
    return frame.resized(max(1, round(width * scale)), max(1, round(height * scale)))


def to_tensors(frame: RgbdFrame, device: torch.device) -> tuple[Tensor, Tensor]:
    """Colour in 0..1 and points in metres, (1, 3, H, W) each, as networks take them."""
    color = torch.from_numpy(frame.color).to(device).float() / 255
    points = torch.from_numpy(geometry.back_project(frame.depth, frame.camera)).to(device)
    # Permuted channels are channels last as they are.
    return color.permute(2, 0, 1)[None], points.permute(2, 0, 1)[None]


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
