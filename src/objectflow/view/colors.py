"""Colours: a colour wheel for directions, a diverging map for depth."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from objectflow.motion.palette import Rgb, object_color
from objectflow.typing import UInt8Array

__all__ = ["INK", "NO_DEPTH", "PAPER", "Rgb", "diverging", "object_color", "wheel"]

INK: Rgb = (33, 37, 41)
PAPER: Rgb = (255, 255, 255)
NO_DEPTH: Rgb = (222, 226, 230)

_RED, _BLUE = np.array([178, 24, 43]), np.array([33, 102, 172])


def wheel(right: NDArray[Any], down: NDArray[Any]) -> UInt8Array:
    """Colour of a 2D displacement: hue = direction, saturation = length; white at 0, full at length 1 and beyond.

    Args:
        right, down: (...) in units of the length at full saturation.

    Returns:
        (..., 3) uint8 RGB.
    """
    moving = (right != 0) | (down != 0)
    image = np.full((*moving.shape, 3), 255, np.uint8)
    image[moving] = _hue(right[moving], down[moving])  # most of a scene stands still
    return image


def _hue(right: NDArray[Any], down: NDArray[Any]) -> UInt8Array:
    """`wheel` of (N,) displacements."""
    length = np.clip(np.hypot(right, down), 0, 1)[..., None]
    angle = np.arctan2(down, right)
    # Cosines with phases 120 degrees apart make hues without the corners of HSV, so that equal angles look alike.
    shift = np.array([0.0, 2 * math.pi / 3, 4 * math.pi / 3])
    hue = 0.5 + 0.5 * np.cos(angle[..., None] - shift)
    hue = hue**0.8 * 235
    return np.asarray(np.rint(255 + (hue - 255) * length**0.8), dtype=np.uint8)


def diverging(value: NDArray[Any]) -> UInt8Array:
    """Colour of a signed value: red at -1 and below, white at 0, blue at 1 and beyond; (...) -> (..., 3) uint8 RGB."""
    moving = np.asarray(value != 0)
    image = np.full((*moving.shape, 3), 255, np.uint8)
    moved = value[moving]
    strength = np.clip(np.abs(moved), 0, 1)[..., None] ** 0.8
    end = np.where((moved < 0)[..., None], _RED, _BLUE)
    image[moving] = np.rint(255 + (end - 255) * strength)
    return image
