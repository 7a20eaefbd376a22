"""Textures of the demo's objects: linear RGB (N, 3) and gloss (N,) at surface points (N, 3).

Points `p` and outward normals `n` are in the object frame; `size` is as in `render_demo.DemoObject`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

Array = NDArray[Any]

_NOISE = np.random.default_rng(7).uniform(size=(256, 256))


def noise(x: Array, y: Array, octaves: int = 4) -> Array:
    """Smooth noise in 0..1 with period 256."""
    total, weight = np.zeros_like(x), 0.0
    for octave in range(octaves):
        coordinates = np.stack([x * 2**octave + 17 * octave, y * 2**octave + 31 * octave])
        total += ndimage.map_coordinates(_NOISE, coordinates, order=1, mode="grid-wrap") * 0.5**octave
        weight += 0.5**octave
    return total / weight


def rgb(code: str) -> Array:
    """Convert a hex colour to linear RGB."""
    return np.asarray((np.array([int(code[i : i + 2], 16) for i in (0, 2, 4)]) / 255) ** 2.2)


def mix(base: Array, color: Array, share: Array) -> Array:
    """Blend colours (N, 3) with another by a share (N,)."""
    return np.asarray(base + (color - base) * np.asarray(share, dtype=float)[:, None])


def wood(xy: Array) -> Array:
    """Planks with wood grain along x."""
    x, y = xy[:, 0], xy[:, 1] + 0.03
    plank = np.floor(y / 0.13)
    x = x + plank * 1.37
    rings = noise(x * 9 + plank * 40, y * 75, 3)
    fiber = noise(x * 45, y * 900, 2)
    tone = np.clip(0.30 + 0.75 * (rings - 0.5) * 1.6 + 0.35 * (fiber - 0.5) + 0.13 * np.sin(plank * 2.4), 0, 1)
    out = mix(np.tile(rgb("d9b384"), (len(x), 1)), rgb("8f5f36"), tone)
    edge = np.abs((y / 0.13) - np.round(y / 0.13)) * 0.13
    return out * (1 - 0.45 * np.exp(-((edge / 0.0012) ** 2)))[:, None]


def _faces(points: Array, normal: Array, size: Array) -> tuple[Array, Array, Array]:
    """Coordinates right and up on the face of a box in metres, and the index of the face, 0..5."""
    axis = np.abs(normal).argmax(-1)
    sign = np.sign(normal[np.arange(len(normal)), axis])
    right = np.where(axis == 0, points[:, 1] * sign, np.where(axis == 1, -points[:, 0] * sign, points[:, 0]))
    up = np.where(axis == 2, points[:, 1], points[:, 2])
    return right, up, axis * 2 + (sign > 0)


def _letters(right: Array, up: Array, left: float, base: float, height: float, seed: int, count: int) -> Array:
    """Whether points lie on a line of pseudo-text: random 3x5 glyphs."""
    glyphs = np.random.default_rng(seed).uniform(size=(count, 5, 3)) > 0.42
    glyphs[:, :, 0] |= True
    width = 0.62 * height
    column, row = (right - left) / width, (up - base) / height
    index = np.floor(column).astype(int)
    x, y = np.floor((column - index) / 0.75 * 3).astype(int), np.floor((1 - row) * 5).astype(int)
    ok = (index >= 0) & (index < count) & (x < 3) & (y >= 0) & (y < 5)
    out = np.zeros(len(right), bool)
    out[ok] = glyphs[index[ok], y[ok], x[ok]]
    return out


def paint_cereal(p: Array, n: Array, size: Array) -> tuple[Array, Array]:
    """An orange box with a bowl of flakes."""
    right, up, _ = _faces(p, n, size)
    out = mix(np.tile(rgb("f2a33a"), (len(p), 1)), rgb("e4572e"), np.clip(0.5 - up / 0.16, 0, 1))
    front = np.abs(n[:, 1]) > 0.5
    bowl = np.hypot(right, (up + 0.035) * 1.15)
    out = mix(out, rgb("fff6e0"), (bowl < 0.040) & front)
    out = mix(out, rgb("2f6690"), (np.abs(bowl - 0.040) < 0.0035) & front)
    flakes = noise(right * 420, up * 420, 2)
    out = mix(out, rgb("b5651d"), (bowl < 0.034) & front & (flakes > 0.54))
    out = mix(out, rgb("7a1f0f"), _letters(right, up, -0.052, 0.030, 0.030, 3, 5) & front)
    out = mix(out, rgb("fff6e0"), _letters(right, up, -0.050, 0.016, 0.008, 4, 18) & front)
    side = ~front & (np.abs(n[:, 2]) < 0.5)
    for line in range(7):
        out = mix(out, rgb("fff6e0"), _letters(right, up, -0.016, 0.05 - 0.014 * line, 0.007, 40 + line, 8) & side)
    return out * (0.94 + 0.12 * noise(right * 300, up * 300)[:, None]), np.full(len(p), 0.10)


def paint_tea(p: Array, n: Array, size: Array) -> tuple[Array, Array]:
    """A green box with leaves, a band and gold edges."""
    right, up, side = _faces(p, n, size)
    out = np.tile(rgb("1f7a5c"), (len(p), 1))
    leaf = noise(right * 130 + side * 9, up * 130, 3)
    out = mix(out, rgb("3fae7c"), leaf > 0.54)
    out = mix(out, rgb("125340"), leaf < 0.43)
    band = (np.abs(up) < 0.013) & (np.abs(n[:, 2]) < 0.5)
    out = mix(out, rgb("f4ead0"), band)
    out = mix(out, rgb("8c2f39"), band & _letters(right, up, -0.034, -0.008, 0.016, 8, 7))
    top = np.abs(n[:, 2]) > 0.5
    out = mix(out, rgb("f4ead0"), top & (np.hypot(right, up) < 0.024))
    out = mix(out, rgb("8c2f39"), top & _letters(right, up, -0.018, -0.006, 0.012, 9, 5))
    out = mix(out, rgb("d4a017"), (np.maximum(np.abs(right) / size[0], np.abs(up) / size[1]) > 0.93) & top)
    return out, np.full(len(p), 0.12)


def paint_can(p: Array, n: Array, size: Array) -> tuple[Array, Array]:
    """A red can with a wavy label and a metal lid."""
    angle, up = np.arctan2(p[:, 1], p[:, 0]), p[:, 2]
    around = angle * size[0]
    out = np.tile(rgb("c1121f"), (len(p), 1))
    wave = up - 0.010 * np.sin(3 * angle)
    out = mix(out, rgb("fdf0d5"), np.abs(wave + 0.004) < 0.014)
    out = mix(out, rgb("003049"), (np.abs(np.abs(wave + 0.004) - 0.017) < 0.002))
    for k, start in enumerate((-0.10, -0.035, 0.030)):
        out = mix(out, rgb("003049"), _letters(around, wave, start, -0.012, 0.016, 20 + k, 5))
    out = mix(out, rgb("fdf0d5"), (noise(around * 200, up * 200, 2) > 0.66) & (np.abs(wave + 0.004) > 0.02))
    metal = (np.abs(up) > size[2] - 0.004) | (np.abs(n[:, 2]) > 0.5)
    rings = 0.5 + 0.5 * np.sin(np.hypot(p[:, 0], p[:, 1]) * 900)
    out = mix(out, rgb("c9ced6"), metal)
    tab = (np.hypot(p[:, 0] - 0.006, p[:, 1] * 1.8) < 0.010) & (n[:, 2] > 0.5)
    out = mix(out, rgb("7d8590"), (metal & (rings > 0.86)) | tab)
    return out, np.where(metal, 0.5, 0.25)


def paint_ball(p: Array, n: Array, size: Array) -> tuple[Array, Array]:
    """A ball of three colours with spots."""
    angle, height = np.arctan2(n[:, 1], n[:, 0]), n[:, 2]
    panel = np.floor((angle / (2 * np.pi) + 0.5) * 6).astype(int) % 3
    out = np.stack([rgb("ffd23f"), rgb("3a86ff"), rgb("fb5607")])[panel]
    out = mix(out, rgb("fffaf0"), np.abs(height) > 0.86)
    stars = noise(p[:, 0] * 260 + 50, p[:, 1] * 260 + p[:, 2] * 190, 2)
    out = mix(out, rgb("fffaf0"), (stars > 0.63) & (np.abs(height) < 0.86))
    out = mix(out, rgb("23395b"), (stars < 0.33) & (np.abs(height) < 0.86))
    return out, np.full(len(p), 0.30)


def paint_book(p: Array, n: Array, size: Array) -> tuple[Array, Array]:
    """A book with hills on its cover, and pages."""
    cover = (np.abs(n[:, 2]) > 0.5) | (n[:, 0] < -0.5)
    right, up = p[:, 0], p[:, 1]
    out = np.tile(rgb("34495e"), (len(p), 1))
    hills = 0.018 * np.sin(right * 60) + 0.012 * np.sin(right * 130 + 1)
    for k, (code, level) in enumerate((("f6bd60", -0.005), ("f28482", -0.025), ("84a59d", -0.045))):
        out = mix(out, rgb(code), up < level + hills * (1 - 0.25 * k))
    out = mix(out, rgb("f7ede2"), np.hypot(right - 0.025, up - 0.025) < 0.014)
    out = mix(out, rgb("f7ede2"), _letters(right, up, -0.050, 0.055, 0.015, 31, 11))
    out = mix(out, rgb("f6bd60"), _letters(right, up, -0.050, 0.043, 0.007, 32, 15))
    pages = np.tile(rgb("efe6d2"), (len(p), 1)) * (0.82 + 0.18 * np.sin(p[:, 2:] * 5200))
    pages = mix(pages, rgb("34495e"), np.abs(p[:, 2]) > size[2] - 0.002)
    return np.where(cover[:, None], out, pages), np.full(len(p), 0.08)


def paint_jar(p: Array, n: Array, size: Array) -> tuple[Array, Array]:
    """A violet jar with diamonds and a wooden lid."""
    angle, up = np.arctan2(p[:, 1], p[:, 0]), p[:, 2]
    out = mix(np.tile(rgb("5b4b8a"), (len(p), 1)), rgb("3d3166"), noise(angle * 9, up * 260, 2))
    diamonds = np.abs((angle * 7 / np.pi) % 1 - 0.5) + np.abs((up / 0.024) % 1 - 0.5)
    out = mix(out, rgb("f0e6ef"), (diamonds < 0.28) & (np.abs(up) < 0.024))
    top = np.abs(n[:, 2]) > 0.5
    out = mix(out, rgb("d8c3a5"), top)
    grain = noise(p[:, 0] * 120, p[:, 1] * 700, 3)
    return mix(out, rgb("a9825a"), top * np.clip((grain - 0.35) * 2.5, 0, 1)), np.full(len(p), 0.18)


PAINT = {
    "cereal box": paint_cereal,
    "tea box": paint_tea,
    "can": paint_can,
    "ball": paint_ball,
    "book": paint_book,
    "jar": paint_jar,
}
