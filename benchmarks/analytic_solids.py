"""The solids of analytic scenes, with their ray intersections and solid textures. See `analytic`."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from scipy import ndimage

from objectflow.typing import Float64Array, IndexArray, Int64Array

Rng = np.random.Generator

TEXEL = 0.003
"""Size of a noise cell, metres: about one pixel of a 320-wide image at 0.7 m."""


@dataclass(frozen=True, eq=False)
class Texture:
    """A solid texture: multi-octave noise between two colours, with stripes or a checker pattern.

    Attributes:
        noise: (n, n, n) or (n, n), 0..1, periodic.
        colors: (3, 3) RGB 0..255 of low noise, high noise and pattern.
        pattern: "stripes", "checker" or "none".
        period: of the pattern, metres.
        direction: (3,) of the stripes.
    """

    noise: Float64Array
    colors: Float64Array
    pattern: str
    period: float
    direction: Float64Array

    def at(self, points: Float64Array) -> Float64Array:
        """RGB (N, 3) at points (N, 3) in metres, in the frame of the textured object."""
        axes = self.noise.ndim
        value = ndimage.map_coordinates(self.noise, points[:, :axes].T / TEXEL, order=1, mode="grid-wrap")[:, None]
        rgb = self.colors[0] * (1 - value) + self.colors[1] * value
        if self.pattern == "checker":
            inside = (np.floor(points / self.period + 0.35).sum(-1) % 2) == 1
        elif self.pattern == "stripes":
            inside = (points @ self.direction / self.period) % 1.0 < 0.3
        else:
            inside = np.zeros(len(points), dtype=bool)
        rgb[inside] = 0.35 * rgb[inside] + 0.65 * self.colors[2]
        return np.asarray(rgb)


@dataclass(frozen=True, eq=False)
class Solid:
    """A convex solid about its origin; `size` holds half extents, (r, r, r), or (r, r, half height)."""

    kind: str
    size: Float64Array
    texture: Texture

    @property
    def radius(self) -> float:
        """Radius of the bounding sphere."""
        if self.kind == "box":
            return float(np.linalg.norm(self.size))
        return float(self.size[0] if self.kind == "sphere" else np.hypot(self.size[0], self.size[2]))

    def support(self, directions: Float64Array) -> Float64Array:
        """Support function (N,) along unit directions (N, 3) of the object frame."""
        if self.kind == "box":
            return np.asarray(np.abs(directions) @ self.size)
        if self.kind == "sphere":
            return np.full(len(directions), self.size[0])
        flat = np.linalg.norm(directions[:, :2], axis=1)
        return np.asarray(flat * self.size[0] + np.abs(directions[:, 2]) * self.size[2])

    def hit(self, origin: Float64Array, rays: Float64Array) -> tuple[Float64Array, Float64Array]:
        """First hits of `origin + t * rays` (N, 3): t (N,), inf for no hit, and outward normals (N, 3)."""
        with np.errstate(divide="ignore", invalid="ignore"):
            if self.kind == "box":
                near, far, axis = _slabs(origin, rays, self.size, range(3))
                normal = np.zeros_like(rays)
                rows = np.arange(len(rays))
                normal[rows, axis] = -np.sign(rays[rows, axis])
            elif self.kind == "sphere":
                near, far = _quadric(origin, rays, self.size[0])
                normal = (origin + near[:, None] * rays) / self.size[0]
            else:
                near, far = _quadric(origin[:2], rays[:, :2], self.size[0])
                cap_near, cap_far, _ = _slabs(origin, rays, self.size, range(2, 3))
                normal = (origin + near[:, None] * rays) / self.size[0] * np.array([1.0, 1, 0])
                cap = cap_near > near
                normal[cap] = np.stack([0 * near[cap], 0 * near[cap], -np.sign(rays[cap, 2])], axis=-1)
                near, far = np.maximum(near, cap_near), np.minimum(far, cap_far)
            ok = (near < far) & (near > 1e-6)
        return np.where(ok, near, np.inf), normal


def _slabs(
    origin: Float64Array, rays: Float64Array, size: Float64Array, axes: range
) -> tuple[Float64Array, Float64Array, IndexArray]:
    """Entry, exit and entry axis of rays through the slabs `|p_axis| < size_axis`."""
    a, b = list(axes), rays[:, list(axes)]
    t0, t1 = (-size[a] - origin[a]) / b, (size[a] - origin[a]) / b
    nears = np.minimum(t0, t1)
    best = np.argmax(nears, axis=1)
    return nears.max(1), np.maximum(t0, t1).min(1), best + axes.start


def _quadric(origin: Float64Array, rays: Float64Array, radius: float) -> tuple[Float64Array, Float64Array]:
    """Entry and exit of rays through a ball (3 columns) or an infinite cylinder (2 columns)."""
    a, b = (rays**2).sum(1), rays @ origin
    root = np.sqrt(b * b - a * (origin @ origin - radius**2))
    return (-b - root) / a, (-b + root) / a


@cache
def _enlargement(count: int, factor: int) -> Float64Array:
    """(factor * count, count): linear interpolation of a periodic row of cells, as by `ndimage.zoom`, but faster."""
    return np.asarray(ndimage.zoom(np.eye(count), (factor, 1), order=1, mode="grid-wrap", grid_mode=True))


def draw_texture(rng: Rng, cells: Int64Array, *, plane: bool = False) -> Texture:
    """Generate a texture of four octaves of noise, normalised to 0..1, between colours of different brightness."""
    noise = np.zeros(tuple(cells))
    for octave, weight in ((16, 1.0), (8, 0.8), (4, 0.7), (2, 0.5)):
        coarse = rng.standard_normal(tuple(cells // octave))
        for axis, count in enumerate(coarse.shape):
            coarse = np.moveaxis(np.tensordot(_enlargement(count, octave), coarse, (1, axis)), 0, axis)
        noise += weight * coarse
    low, high = np.percentile(noise, [5, 95])
    hue = rng.permutation(3)
    dark, bright = rng.uniform(10, 80, 3), rng.uniform(120, 200, 3)
    bright[hue[0]] = rng.uniform(200, 255)
    bright[hue[1]] = rng.uniform(70, 150)
    if plane:  # Less contrast and saturation than the objects.
        grey = rng.uniform(130, 200)
        bright, dark = grey + rng.uniform(-20, 20, 3), 0.4 * grey + rng.uniform(-15, 15, 3)
    pattern = str(rng.choice(["none", "stripes"] if plane else ["stripes", "checker", "none"]))
    accent = rng.uniform(0, 90, 3) if rng.random() < 0.5 else rng.uniform(190, 255, 3)
    direction = unit(rng.standard_normal(3) * (np.array([1.0, 1, 0]) if plane else 1))
    period = float(rng.uniform(0.08, 0.15) if plane else rng.uniform(0.02, 0.04))
    value = np.clip((noise - low) / (high - low), 0, 1)
    return Texture(value, np.stack([dark, bright, accent]), pattern, period, direction)


def unit(vector: Any) -> Float64Array:
    return np.asarray(vector / np.linalg.norm(vector), dtype=np.float64)
