"""The colour of each object id, the same in every picture."""

from __future__ import annotations

import colorsys

Rgb = tuple[int, int, int]

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
"""Eight hues that are distinguishable on photographs and for most colour-blind readers."""


def object_color(object_id: int) -> Rgb:
    """The colour of an object id (from 1), the same in every picture; ids beyond the palette use the golden angle."""
    if object_id <= len(_PALETTE):
        return _PALETTE[object_id - 1]
    hue = (object_id * 0.618033988749895) % 1.0
    red, green, blue = colorsys.hsv_to_rgb(hue, 0.75, 0.85)
    return round(red * 255), round(green * 255), round(blue * 255)
