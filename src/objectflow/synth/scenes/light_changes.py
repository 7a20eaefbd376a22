"""Light that changes between the two frames of a pair, and places for bodies outside the view that cast shadows."""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from objectflow.geometry.camera import Camera
from objectflow.synth.scenes.scene_data import Light, Vector
from objectflow.typing import Float64Array

PLACES = 24
"""Number of places that are tried for a shadow caster."""


def draw_hard_lights(rng: np.random.Generator, count: tuple[int, int]) -> tuple[Light, ...]:
    """Draw lamps of which one or two dominate, so that shadows on a plain table are hard and dark.

    Args:
        rng: source of randomness.
        count: minimum and maximum number of lamps.
    """
    number = int(rng.integers(count[0], count[1] + 1))
    energies = rng.dirichlet(np.full(number, 0.8)) * rng.uniform(0.3, 0.75)
    ambient = rng.uniform(0.42, 0.8) / number
    tone = 1 + rng.uniform(-0.1, 0.1) * np.array([1.0, 0.0, -1.0])
    lights = []
    for energy in energies:
        azimuth, elevation = rng.uniform(0, 2 * math.pi), math.radians(rng.uniform(30, 85))
        distance = rng.uniform(0.9, 2.5)
        tint = 1 + rng.uniform(-0.12, 0.12) * np.array([1.0, 0.0, -1.0])
        radius = distance * math.cos(elevation)
        position = np.array([radius * math.cos(azimuth), radius * math.sin(azimuth), distance * math.sin(elevation)])
        lights.append(
            Light(
                _vector(position),
                _vector(energy * tint),
                _vector(min(1.0, 1.5 * energy) * tint),
                _vector(ambient * tone),
            )
        )
    return tuple(lights)


def change_lights(rng: np.random.Generator, lights: tuple[Light, ...]) -> tuple[Light, ...]:
    """The lights of the other frame: brighter or darker lamps, one of them perhaps moved, other ambient light."""
    ambient = math.exp(rng.normal(0, 0.12))
    moved = int(rng.integers(len(lights))) if rng.random() < 0.3 else -1
    changed = []
    for number, light in enumerate(lights):
        strength = math.exp(rng.normal(0, 0.25))
        offset = rng.normal(0, 0.12, 3) if number == moved else np.zeros(3)
        changed.append(
            dataclasses.replace(
                light,
                position=_vector(np.maximum(np.asarray(light.position) + offset, (-np.inf, -np.inf, 0.3))),
                diffuse=_vector(strength * np.asarray(light.diffuse)),
                specular=_vector(np.minimum(strength * np.asarray(light.specular), 1.0)),
                ambient=_vector(ambient * np.asarray(light.ambient)),
            )
        )
    return tuple(changed)


def place_shadow_caster(
    rng: np.random.Generator, light: Light, radius: float, size: float, cameras: Float64Array, intrinsics: Camera
) -> Float64Array | None:
    """Find two positions between a light and the table that no camera sees.

    Args:
        rng: source of randomness.
        light: the lamp whose light is blocked.
        radius: of the disc on the table into which the shadow falls, metres.
        size: radius of the shadow caster's bounding sphere, metres.
        cameras: (2, 4, 4) `world_T_camera` of the two frames.
        intrinsics: of the cameras.

    Returns:
        (2, 3) positions in the two frames, metres; None if all places that were tried are within sight.
    """
    lamp = np.asarray(light.position)
    for _ in range(PLACES):
        angle, distance = rng.uniform(0, 2 * math.pi), radius * math.sqrt(rng.random())
        spot = np.array([distance * math.cos(angle), distance * math.sin(angle), 0.0])
        first = spot + rng.uniform(0.25, 0.8) * (lamp - spot)
        step = rng.normal(size=3) * rng.choice([0.0, 0.03, 0.12], p=(0.15, 0.35, 0.5)) * size / 0.25
        places = np.stack([first, first + step])
        if not any(_in_sight(place, size, camera, intrinsics) for place, camera in zip(places, cameras, strict=True)):
            return places
    return None


def _in_sight(center: Float64Array, size: float, camera: Float64Array, intrinsics: Camera) -> bool:
    """Whether a sphere reaches into a camera's field of view."""
    x, y, z = camera[:3, :3].T @ (center - camera[:3, 3])
    c = intrinsics
    for along, focal, low, high in (
        (x, c.fx, -0.5 - c.cx, c.width - 0.5 - c.cx),
        (y, c.fy, -0.5 - c.cy, c.height - 0.5 - c.cy),
    ):
        if (along * focal - high * z) / math.hypot(focal, high) > size:
            return False
        if (low * z - along * focal) / math.hypot(focal, low) > size:
            return False
    return bool(z > -size)


def _vector(values: Float64Array) -> Vector:
    x, y, z = map(float, values)
    return x, y, z
