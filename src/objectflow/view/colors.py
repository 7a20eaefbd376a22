"""Colours: one for each object, a wheel for directions, a diverging bar for depth."""

from __future__ import annotations

import colorsys
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from objectflow.typing import UInt8Array

Rgb = tuple[int, int, int]

INK: Rgb = (33, 37, 41)
PAPER: Rgb = (255, 255, 255)
NO_DEPTH: Rgb = (222, 226, 230)

_PALETTE: tuple[Rgb, ...] = (
    (230, 57, 70),
    (29, 120, 214),
    (43, 160, 80),
    (247, 148, 29),
    (142, 68, 190),
    (0, 168, 181),
    (214, 51, 132),
    (148, 120, 30),
)
"""Eight hues that stay apart on photographs and for most colour-blind readers."""

_RED, _BLUE = np.array([178, 24, 43]), np.array([33, 102, 172])


def object_color(object_id: int) -> Rgb:
    """The colour of an object's id (from 1); the same in every picture, endless by the golden angle."""
    if object_id <= len(_PALETTE):
        return _PALETTE[object_id - 1]
    hue = (object_id * 0.618033988749895) % 1.0
    red, green, blue = colorsys.hsv_to_rgb(hue, 0.75, 0.85)
    return round(red * 255), round(green * 255), round(blue * 255)


def wheel(right: NDArray[Any], down: NDArray[Any]) -> UInt8Array:
    """Colour of a 2D displacement: hue = direction, strength = length; white at 0, full at length 1 and beyond.

    Args:
        right, down: (...) in units of the length that gets the full colour.

    Returns:
        (..., 3) uint8 RGB.
    """
    length = np.clip(np.hypot(right, down), 0, 1)[..., None]
    angle = np.arctan2(down, right)
    # Cosines a third of a turn apart: hues without the corners of HSV, so that equal turns look equally different.
    shift = np.array([0.0, 2 * math.pi / 3, 4 * math.pi / 3])
    hue = 0.5 + 0.5 * np.cos(angle[..., None] - shift)
    hue = hue**0.8 * 235
    return np.asarray(np.rint(255 + (hue - 255) * length**0.8), dtype=np.uint8)


def diverging(value: NDArray[Any]) -> UInt8Array:
    """Colour of a signed value: red at -1 and below, white at 0, blue at 1 and beyond; (...) -> (..., 3) uint8 RGB."""
    strength = np.clip(np.abs(value), 0, 1)[..., None] ** 0.8
    end = np.where((value < 0)[..., None], _RED, _BLUE)
    return np.asarray(np.rint(255 + (end - 255) * strength), dtype=np.uint8)
