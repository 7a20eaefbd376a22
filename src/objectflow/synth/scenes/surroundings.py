"""Support and surroundings of clutter scenes: a table, a floor or a bin, and walls."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from objectflow.synth.scenes.scene_data import Floor, Slab
from objectflow.synth.scenes.textures import TextureSpec
from objectflow.typing import Float64Array

CAMERA_CLEARANCE = 0.05
"""Minimum distance between a camera and a slab along the slab's axes, metres."""
BARE = Floor(TextureSpec("plain"), 1.0, 0.0, 0.1)
"""Placeholder for a surface that is drawn later."""


@dataclass(frozen=True)
class Surroundings:
    """The fixed parts of a scene; the objects' support is at height 0.

    Attributes:
        floor: height of the floor, metres; 0 where the objects lie on it.
        slabs: each with the name of its group; the slabs of a group share a surface.
        front: azimuth of the side without walls, radians.
        walls: whether there are walls.
    """

    floor: float
    slabs: tuple[tuple[str, Slab], ...]
    front: float
    walls: bool


def draw_surroundings(
    rng: np.random.Generator, radius: float, *, tables: float = 0.6, bins: float = 0.15
) -> Surroundings:
    """Draw the surroundings of a disc of objects: a table or a floor, a bin or none, up to two walls.

    Args:
        rng: source of randomness.
        radius: of the disc, metres.
        tables, bins: shares of scenes with a table and with a bin, 0..1.
    """
    front = float(rng.uniform(0, 2 * math.pi))
    table, in_bin, walls = rng.random() < tables, rng.random() < bins, int(rng.choice(3, p=(0.3, 0.4, 0.3)))
    slabs: list[tuple[str, Slab]] = []
    floor = 0.0
    if table:
        floor = -float(rng.uniform(0.35, 0.85))
        thickness = float(rng.uniform(0.015, 0.05))
        half = (radius + float(rng.uniform(0.08, 0.5)), radius + float(rng.uniform(0.08, 0.35)), thickness / 2)
        x, y = map(float, rng.uniform(-0.05, 0.05, 2))
        slabs.append(("table", Slab((x, y, -thickness / 2), front + float(rng.normal(0, 0.3)), half, BARE)))
    if in_bin:
        slabs += _draw_bin(rng, radius)
    for number in range(walls):
        # The first wall is at the back, opposite to `front`; the second is at one side of it.
        azimuth = front + math.pi + float(rng.normal(0, 0.15)) + number * float(rng.choice((-1, 1))) * math.pi / 2
        distance = radius + float(rng.uniform(0.25, 1.0)) + 0.3 * number
        height = float(rng.uniform(0.8, 1.8))
        center = (
            distance * math.cos(azimuth),
            distance * math.sin(azimuth),
            floor + height / 2,
        )
        slabs.append(("wall", Slab(center, azimuth, (0.02, 1.8, height / 2), BARE)))
    return Surroundings(floor, tuple(slabs), front, walls > 0)


def _draw_bin(rng: np.random.Generator, radius: float) -> list[tuple[str, Slab]]:
    """Draw the four sides of a bin around the objects."""
    a, b = radius + float(rng.uniform(0.06, 0.15)), radius + float(rng.uniform(0.06, 0.15))
    height, thin, yaw = float(rng.uniform(0.05, 0.16)), 0.006, float(rng.uniform(0, math.pi))
    sides = []
    for x, y, half in (
        (a, 0.0, (thin, b + thin, height / 2)),
        (-a, 0.0, (thin, b + thin, height / 2)),
        (0.0, b, (a - thin, thin, height / 2)),
        (0.0, -b, (a - thin, thin, height / 2)),
    ):
        c, s = math.cos(yaw), math.sin(yaw)
        sides.append(("bin", Slab((c * x - s * y, s * x + c * y, height / 2), yaw, half, BARE)))
    return sides


def is_unobstructed(slabs: tuple[Slab, ...], eye: Float64Array, target: Float64Array) -> bool:
    """Whether no slab is between a camera and its target or within `CAMERA_CLEARANCE` of the camera.

    Args:
        slabs: the fixed boxes of a scene.
        eye, target: (3,) positions in the world, metres.
    """
    for slab in slabs:
        c, s = math.cos(slab.yaw), math.sin(slab.yaw)
        slab_R_world = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        start, end = (slab_R_world @ (np.asarray(p) - slab.center) for p in (eye, target))
        half = np.asarray(slab.half)
        if (np.abs(start) <= half + CAMERA_CLEARANCE).all():
            return False
        if _segment_hits_box(start, end, half):
            return False
    return True


def _segment_hits_box(start: Float64Array, end: Float64Array, half: Float64Array) -> bool:
    """Whether the line segment between two points intersects an axis-aligned box about the origin (slab method)."""
    direction = end - start
    safe = np.where(np.abs(direction) < 1e-12, 1e-12, direction)
    a, b = (-half - start) / safe, (half - start) / safe
    first, last = float(np.minimum(a, b).max()), float(np.maximum(a, b).min())
    return max(first, 0.0) < min(last, 1.0)
