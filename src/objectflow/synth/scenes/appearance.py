"""Appearance: colours, textures and reflectance of objects and floors, and the lights."""

from __future__ import annotations

import colorsys
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from objectflow.synth.scenes.scene_data import Floor, Light
from objectflow.synth.scenes.textures import FLOOR_KINDS, OBJECT_KINDS, Rgb, TextureSpec
from objectflow.typing import Float64Array

HsvRange = tuple[tuple[float, float], tuple[float, float], tuple[float, float]]
"""Ranges of hue, saturation and value, each 0..1."""

_FLOOR_COLORS: dict[str, HsvRange] = {
    "wood": ((0.04, 0.12), (0.25, 0.65), (0.35, 0.8)),
    "tiles": ((0.0, 1.0), (0.02, 0.3), (0.5, 0.95)),
    "gravel": ((0.05, 0.15), (0.05, 0.3), (0.4, 0.8)),
}
"""Colours of floor textures with a typical colour."""
_ANY_FLOOR: HsvRange = ((0.0, 1.0), (0.02, 0.5), (0.35, 0.9))
_OBJECT: HsvRange = ((0.0, 1.0), (0.05, 0.85), (0.35, 0.97))


def draw_surface(rng: np.random.Generator, own_texture: bool) -> tuple[TextureSpec, float, float]:
    """Draw an object's texture, specular coefficient and shininess; half of the objects are shiny."""
    kind = OBJECT_KINDS[int(rng.choice(len(OBJECT_KINDS), p=(0.35, 0.2, 0.2, 0.25)))]
    spec = TextureSpec(kind, int(rng.integers(2**31)), _colors(rng, _OBJECT), int(rng.integers(2, 6)))
    if own_texture:
        spec = TextureSpec("model")
    shiny = rng.random() < 0.5
    specular = rng.uniform(0.3, 0.9) if shiny else rng.uniform(0.0, 0.15)
    shininess = rng.uniform(0.3, 0.9) if shiny else rng.uniform(0.05, 0.3)
    return spec, float(specular), float(shininess)


def draw_floor(rng: np.random.Generator, images: Sequence[Path], image_share: float) -> Floor:
    """Draw a floor: an image with probability `image_share`, otherwise a procedural texture in plausible colours."""
    is_image = rng.random() < image_share
    if images and is_image:
        path = images[int(rng.integers(len(images)))]
        texture = TextureSpec("image", path=str(path))
        tile = rng.uniform(0.5, 1.2)
    else:
        kind = FLOOR_KINDS[int(rng.integers(len(FLOOR_KINDS)))]
        colors = _colors(rng, _FLOOR_COLORS.get(kind, _ANY_FLOOR))
        texture = TextureSpec(kind, int(rng.integers(2**31)), colors, int(rng.integers(3, 8)))
        tile = rng.uniform(0.4, 1.0)
    return Floor(texture, float(tile), float(rng.uniform(0, 0.2)), float(rng.uniform(0.05, 0.5)))


def draw_lights(rng: np.random.Generator, count: tuple[int, int]) -> tuple[Light, ...]:
    """Draw lamps around the scene, from warm to cold, whose total energy gives well-exposed images.

    Most of the light is ambient, as it is in a room with bright walls and a ceiling: shadows are soft, and a rotating
    object keeps most of its brightness.
    """
    number = int(rng.integers(count[0], count[1] + 1))
    energies = rng.dirichlet(np.full(number, 2.0)) * rng.uniform(0.2, 0.6)
    ambient = rng.uniform(0.5, 0.75) / number
    lights = []
    for energy in energies:
        azimuth, elevation = rng.uniform(0, 2 * math.pi), math.radians(rng.uniform(35, 85))
        distance = rng.uniform(0.8, 2.5)
        warmth = rng.uniform(-0.15, 0.15)
        tint = np.array([1 + warmth, 1.0, 1 - warmth])
        diffuse, specular = energy * tint, min(1.0, 1.5 * energy) * tint
        radius = distance * math.cos(elevation)
        position = (radius * math.cos(azimuth), radius * math.sin(azimuth), distance * math.sin(elevation))
        lights.append(Light(position, _vector(diffuse), _vector(specular), (float(ambient),) * 3))
    return tuple(lights)


def _colors(rng: np.random.Generator, colors: HsvRange) -> tuple[Rgb, Rgb, Rgb]:
    """Draw three matching colours: two of neighbouring hues, and one that is neutral or of the opposite hue."""
    hue, saturation, value = (float(rng.uniform(*limits)) for limits in colors)
    near = hue + float(rng.uniform(-0.07, 0.07))
    darker = value * float(rng.uniform(0.5, 0.9)) if value > 0.5 else min(1.0, value * float(rng.uniform(1.3, 2.2)))
    contrast = float(rng.uniform(0.0, 1.0))
    accent = (contrast, 0.05, contrast) if rng.random() < 0.6 else (hue + 0.5, saturation, value)
    return _rgb(hue, saturation, value), _rgb(near, saturation, darker), _rgb(*accent)


def _rgb(hue: float, saturation: float, value: float) -> Rgb:
    red, green, blue = (round(255 * part) for part in colorsys.hsv_to_rgb(hue % 1, saturation, value))
    return red, green, blue


def _vector(values: Float64Array) -> tuple[float, float, float]:
    x, y, z = map(float, values)
    return x, y, z
