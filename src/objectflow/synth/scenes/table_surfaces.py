"""Surfaces of tables, sheets of paper on them, and large things in the background."""

from __future__ import annotations

import colorsys
import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from objectflow.synth.scenes.appearance import draw_floor
from objectflow.synth.scenes.scene_data import Floor, Slab
from objectflow.synth.scenes.surroundings import BARE, Surroundings
from objectflow.synth.scenes.textures import Rgb, TextureSpec

GroupedSlab = tuple[str, Slab]

SHEET_PIXELS, THING_PIXELS = 128, 256
"""Side lengths of the textures of sheets and of plain tables, walls and large boxes, pixels."""


def draw_table_surface(rng: np.random.Generator, images: Sequence[Path], image_share: float, plain: float) -> Floor:
    """Draw a table's surface: a plain light one with probability `plain`, otherwise any floor's."""
    if rng.random() >= plain:
        return draw_floor(rng, images, image_share)
    hue, value = float(rng.random()), float(rng.uniform(0.72, 0.97))
    saturation = float(rng.choice([rng.uniform(0.0, 0.08), rng.uniform(0.1, 0.4)], p=(0.7, 0.3)))
    if rng.random() < 0.35:  # light wood
        hue, saturation = float(rng.uniform(0.06, 0.12)), float(rng.uniform(0.1, 0.35))
    light, second = _rgb(hue, saturation, value), _rgb(hue, saturation, 0.9 * value)
    kind = str(rng.choice(("plain", "noise"), p=(0.8, 0.2)))
    texture = TextureSpec(kind, int(rng.integers(2**31)), (light, second, light), int(rng.integers(2, 9)))
    shiny = rng.random() < 0.3
    specular = float(rng.uniform(0.1, 0.4)) if shiny else 0.03
    return Floor(texture, float(rng.uniform(0.5, 1.5)), specular, 0.3, pixels=THING_PIXELS)


def draw_sheets(rng: np.random.Generator, radius: float) -> tuple[GroupedSlab, ...]:
    """Draw up to three sheets of paper, mats or notebooks on the table."""
    sheets = []
    for number in range(int(rng.choice(4, p=(0.45, 0.3, 0.15, 0.1)))):
        x, y = map(float, rng.uniform(-1.1, 1.1, 2) * radius)
        half = (float(rng.uniform(0.05, 0.16)), float(rng.uniform(0.04, 0.12)), float(rng.uniform(0.0005, 0.003)))
        sheets.append((f"sheet-{number}", Slab((x, y, half[2]), float(rng.uniform(0, math.pi)), half, BARE)))
    return tuple(sheets)


def draw_background(rng: np.random.Generator, surroundings: Surroundings, radius: float) -> tuple[GroupedSlab, ...]:
    """Draw up to five large boxes beyond the table: furniture, screens, cartons."""
    things = []
    for number in range(int(rng.integers(0, 6))):
        azimuth = surroundings.front + math.pi + float(rng.uniform(-1.2, 1.2))
        distance = radius + float(rng.uniform(0.5, 1.6))
        half = tuple(float(side) for side in rng.uniform((0.05, 0.1, 0.15), (0.3, 0.4, 0.6)))
        center = (distance * math.cos(azimuth), distance * math.sin(azimuth), surroundings.floor + half[2])
        things.append(
            (f"thing-{number}", Slab(center, azimuth + float(rng.normal(0, 0.4)), (half[0], half[1], half[2]), BARE))
        )
    return tuple(things)


def surface_slabs(
    rng: np.random.Generator,
    slabs: Sequence[GroupedSlab],
    table: Floor,
    images: Sequence[Path],
    image_share: float,
) -> tuple[Slab, ...]:
    """Give every slab its group's surface; the table has the given one, and half of the walls are plain.

    Args:
        rng: source of randomness.
        slabs: each with the name of its group.
        table: surface of the group "table".
        images, image_share: see `draw_floor`.
    """
    surfaces: dict[str, Floor] = {"table": table}
    for group, _ in slabs:
        if group not in surfaces:
            plain = rng.random() < 0.5
            surface = draw_table_surface(rng, images, image_share, 1.0 if plain else 0.0)
            surfaces[group] = dataclasses.replace(surface, pixels=SHEET_PIXELS if "sheet" in group else THING_PIXELS)
    return tuple(dataclasses.replace(slab, surface=surfaces[group]) for group, slab in slabs)


def _rgb(hue: float, saturation: float, value: float) -> Rgb:
    red, green, blue = (round(255 * part) for part in colorsys.hsv_to_rgb(hue % 1, saturation, value))
    return red, green, blue
