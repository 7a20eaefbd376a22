"""Anti-aliased drawing of shapes and text with OpenCV, in RGB and with sub-pixel coordinates."""

from __future__ import annotations

import math
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from objectflow.typing import LabelImage, UInt8Array
from objectflow.view.colors import Rgb

Point = tuple[float, float]

_SHIFT = 4
"""Fractional bits of OpenCV's fixed-point coordinates, i.e. 1/16 pixel."""


def blend(image: UInt8Array, color: Rgb, alpha: NDArray[Any]) -> UInt8Array:
    """Blend a colour over an (H, W, 3) image with an (H, W) opacity in 0..1."""
    opacity = np.asarray(alpha, dtype=np.float32)[..., None]
    mixed = image.astype(np.float32)
    mixed += (np.array(color, dtype=np.float32) - mixed) * opacity
    return np.rint(mixed).astype(np.uint8)


def polygon(image: UInt8Array, points: list[Point], color: Rgb) -> None:
    """Fill a convex polygon."""
    cv2.fillConvexPoly(image, _fixed(points), color, cv2.LINE_AA, _SHIFT)


def line(image: UInt8Array, points: list[Point], color: Rgb, width: int) -> None:
    """Draw an open polyline."""
    cv2.polylines(image, [_fixed(points)], False, color, max(1, width), cv2.LINE_AA, _SHIFT)


def disk(image: UInt8Array, center: Point, radius: float, color: Rgb) -> None:
    """Fill a circle."""
    x, y = _fixed([center])[0]
    cv2.circle(image, (int(x), int(y)), round(radius * 2**_SHIFT), color, -1, cv2.LINE_AA, _SHIFT)


def arrow(image: UInt8Array, start: Point, end: Point, color: Rgb, width: float, edge: Rgb) -> None:
    """Draw an arrow with a solid head and an outline in `edge`, from exactly `start` to exactly `end`.

    Args:
        image: (H, W, 3) uint8 RGB, changed in place.
        start, end: pixels.
        color: of the inside.
        width: of the shaft, pixels; short arrows are thinner.
        edge: of the outline.
    """
    a, b = np.array(start), np.array(end)
    length = float(np.linalg.norm(b - a))
    if length < 1e-6:
        return
    along = (b - a) / length
    side = np.array([-along[1], along[0]])
    width = min(width, 0.22 * length)
    # The head of a short arrow takes up to 70% of its length.
    head, wing = min(4.2 * width, 0.7 * length), 1.9 * width
    rim = 0.28 * width
    neck = b - along * head
    # The outline keeps its distance to all sides of the head, which are inclined by wing over head.
    tip_rim = rim * math.hypot(head, wing) / wing
    inner_wing = wing * (head - tip_rim - rim) / head
    for half, tail, base, tip, spread in (
        (width / 2, a, neck, b, wing),
        (width / 2 - rim, a + along * rim, neck + along * rim, b - along * tip_rim, inner_wing),
    ):
        shaft = [tail + side * half, base + side * half, base - side * half, tail - side * half]
        shade = edge if base is neck else color
        for shape in (shaft, [tip, base + side * spread, base - side * spread]):
            polygon(image, [(float(x), float(y)) for x, y in shape], shade)


def text_size(text: str, size: float, *, bold: bool = False) -> tuple[float, float]:
    """Width of a line of text and height of its capitals, pixels, at a line height of `size` pixels."""
    if hasattr(cv2, "FontFace"):
        x, _, width, _ = cv2.getTextSize((1, 1), _plain(text), (0, 0), _font(), _points(size), 600 if bold else 400)
        return float(x + width), 0.72 * size
    (width, _), _ = cv2.getTextSize(_ascii(text), cv2.FONT_HERSHEY_DUPLEX, size / 30, _stroke(size, bold))
    return float(width), 0.72 * size


def write(
    image: UInt8Array, text: str, left: float, baseline: float, size: float, color: Rgb, *, bold: bool = False
) -> None:
    """Write a line of text whose first letter starts at (`left`, `baseline`)."""
    origin = (round(left), round(baseline))
    if hasattr(cv2, "FontFace"):
        # OpenCV 5 has TrueType fonts.
        cv2.putText(image, _plain(text), origin, color, _font(), _points(size), 600 if bold else 400)
    else:
        cv2.putText(
            image, _ascii(text), origin, cv2.FONT_HERSHEY_DUPLEX, size / 30, color, _stroke(size, bold), cv2.LINE_AA
        )


def _font() -> Any:
    return cv2.FontFace("sans")


def _plain(text: str) -> str:
    """Replace zeros, which the TrueType font of OpenCV 5 strikes through, by its letter O."""
    return text.replace("0", "O")


def _ascii(text: str) -> str:
    """Replace the degree sign, which OpenCV 4's stroke font lacks."""
    return text.replace("°", " deg")


def _points(size: float) -> int:
    return max(6, round(size))


def _stroke(size: float, bold: bool) -> int:
    return max(1, round(size / 16)) + int(bold)


def _fixed(points: list[Point]) -> LabelImage:
    return np.asarray(np.rint(np.array(points, dtype=np.float64) * 2**_SHIFT), dtype=np.int32)
