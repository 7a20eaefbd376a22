"""Where things lie in the preset `wild`: on a table with edges, on a floor or in a bin, with walls behind."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from objectflow.synth.scenes.scene_data import Floor, Slab
from objectflow.synth.scenes.textures import TextureSpec
from objectflow.typing import Float64Array

_BARE = Floor(TextureSpec("plain"), 1.0, 0.0, 0.1)


@dataclass(frozen=True)
class Surroundings:
    """What stands around the objects, whose support is at height 0.

    Attributes:
        floor: its height; 0 where objects lie on it.
        slabs: each with the name of its group, which shares a surface.
        front: azimuth, radians, of the side without walls.
        walls: whether there are any.
    """

    floor: float
    slabs: tuple[tuple[str, Slab], ...]
    front: float
    walls: bool


def draw_surroundings(rng: np.random.Generator, radius: float) -> Surroundings:
    """Draw what is around a disc of objects of a radius in metres: half of them are tables, some hold a bin."""
    front = float(rng.uniform(0, 2 * math.pi))
    table, bin_, walls = rng.random() < 0.6, rng.random() < 0.15, int(rng.choice(3, p=(0.3, 0.4, 0.3)))
    slabs: list[tuple[str, Slab]] = []
    floor = 0.0
    if table:
        floor = -float(rng.uniform(0.35, 0.85))
        thickness = float(rng.uniform(0.015, 0.05))
        half = (radius + float(rng.uniform(0.08, 0.5)), radius + float(rng.uniform(0.08, 0.35)), thickness / 2)
        x, y = map(float, rng.uniform(-0.05, 0.05, 2))
        slabs.append(("table", Slab((x, y, -thickness / 2), front + float(rng.normal(0, 0.3)), half, _BARE)))
    if bin_:
        slabs += _bin(rng, radius)
    for side in range(walls):
        # The first behind, seen from the front; the second at one side of it.
        azimuth = front + math.pi + float(rng.normal(0, 0.15)) + side * float(rng.choice((-1, 1))) * math.pi / 2
        distance = radius + float(rng.uniform(0.25, 1.0)) + 0.3 * side
        height = float(rng.uniform(0.8, 1.8))
        center = (
            distance * math.cos(azimuth),
            distance * math.sin(azimuth),
            floor + height / 2,
        )
        slabs.append(("wall", Slab(center, azimuth, (0.02, 1.8, height / 2), _BARE)))
    return Surroundings(floor, tuple(slabs), front, walls > 0)


def _bin(rng: np.random.Generator, radius: float) -> list[tuple[str, Slab]]:
    """Four sides around the objects."""
    a, b = radius + float(rng.uniform(0.06, 0.15)), radius + float(rng.uniform(0.06, 0.15))
    height, thin, turn = float(rng.uniform(0.05, 0.16)), 0.006, float(rng.uniform(0, math.pi))
    sides = []
    for x, y, half in (
        (a, 0.0, (thin, b + thin, height / 2)),
        (-a, 0.0, (thin, b + thin, height / 2)),
        (0.0, b, (a - thin, thin, height / 2)),
        (0.0, -b, (a - thin, thin, height / 2)),
    ):
        c, s = math.cos(turn), math.sin(turn)
        sides.append(("bin", Slab((c * x - s * y, s * x + c * y, height / 2), turn, half, _BARE)))
    return sides


def is_open(slabs: tuple[Slab, ...], eye: Float64Array, target: Float64Array) -> bool:
    """Whether nothing stands between an eye and its target, and no slab is within 5 cm of the eye."""
    for slab in slabs:
        c, s = math.cos(slab.turn), math.sin(slab.turn)
        slab_R_world = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        start, end = (slab_R_world @ (np.asarray(p) - slab.center) for p in (eye, target))
        half = np.asarray(slab.half)
        if (np.abs(start) <= half + 0.05).all():
            return False
        if _crosses(start, end, half):
            return False
    return True


def _crosses(start: Float64Array, end: Float64Array, half: Float64Array) -> bool:
    """Whether a straight line between two points goes through a box about the origin."""
    way = end - start
    safe = np.where(np.abs(way) < 1e-12, 1e-12, way)
    a, b = (-half - start) / safe, (half - start) / safe
    first, last = float(np.minimum(a, b).max()), float(np.maximum(a, b).min())
    return max(first, 0.0) < min(last, 1.0)
