"""Tubes along a path, extruded outlines, and closed rings."""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import ArrayLike

from objectflow.synth.objects.shapes.outline import circle, inset
from objectflow.synth.objects.shapes.solid import Solid, loft
from objectflow.typing import Float64Array


def tube(
    path: ArrayLike,
    radius: float | ArrayLike,
    section: Float64Array | None = None,
    up: ArrayLike = (0, 0, 1),
    parts: int = 4,
) -> Solid:
    """Sweep a section along a path.

    Args:
        path: (N, 3) metres, without repeated points.
        radius: metres; one for all points, or one per point.
        section: (K, 2) outline of unit radius; its x axis is perpendicular to `up`, its y axis points towards `up`.
            None for a circle with 12 sides.
        up: (3,) direction that fixes the section's orientation; the path must not be parallel to it.
        parts: number of convex parts along the path.
    """
    p = np.asarray(path, dtype=np.float64)
    outline = circle(12) if section is None else section
    forward = np.gradient(p, axis=0)
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    side = np.cross(forward, np.asarray(up, dtype=np.float64))
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    above = np.cross(side, forward)
    r = np.broadcast_to(np.asarray(radius, dtype=np.float64), (len(p),))[:, None, None]
    rings = p[:, None] + r * (outline[None, :, :1] * side[:, None] + outline[None, :, 1:] * above[:, None])
    return loft(rings, segment_hulls(rings, parts))


def segment_hulls(rings: Float64Array, parts: int) -> list[Float64Array]:
    """Convex parts of a sequence of rings (M, K, 3): `parts` segments that share their end rings."""
    cuts = np.unique(np.linspace(0, len(rings) - 1, parts + 1).round().astype(int))
    return [rings[start : stop + 1].reshape(-1, 3) for start, stop in itertools.pairwise(cuts)]


def extrude(
    outline: Float64Array, height: float, bevel: float = 0.0, parts: list[Float64Array] | None = None
) -> Solid:
    """Extrude an outline (K, 2) in metres, star-shaped about its mean, from z = 0 to `height`.

    The edges at both ends are bevelled by `bevel` metres. `parts` are outlines (P, 2) whose convex hulls cover the
    shape; None for a convex outline.
    """
    levels = (
        [(0.0, bevel), (bevel, 0.0), (height - bevel, 0.0), (height, bevel)] if bevel > 0 else [(0, 0), (height, 0)]
    )
    rings = np.stack([np.column_stack([inset(outline, cut), np.full(len(outline), z)]) for z, cut in levels])
    if parts is None:
        return loft(rings, [rings.reshape(-1, 3)])
    hulls = [
        np.concatenate([np.column_stack([p, np.zeros(len(p))]), np.column_stack([p, np.full(len(p), height)])])
        for p in parts
    ]
    return loft(rings, hulls)


def hoop(inside: Float64Array, outside: Float64Array, height: float, wedges: int, bulge: int = 1) -> Solid:
    """A closed ring between two outlines with equal numbers of points, symmetric about the plane z = 0.

    Args:
        inside, outside: (K, 2) metres.
        height: metres along z.
        wedges: number of convex parts around the ring.
        bulge: 1 for a square section; larger values give a rounder one with that many points per quarter.
    """
    if bulge == 1:
        section = np.array([[0, -1], [1, -1], [1, 1], [0, 1]], dtype=np.float64)
    else:
        angle = 2 * np.pi * np.arange(4 * bulge) / (4 * bulge)
        section = np.stack([0.5 + 0.5 * np.cos(angle), np.sin(angle)], axis=1)
    flat = inside[:, None] + section[None, :, :1] * (outside - inside)[:, None]
    z = np.broadcast_to(section[None, :, 1:] * height / 2, (*flat.shape[:2], 1))
    rings = np.concatenate([flat, z], axis=-1)
    parts = segment_hulls(np.concatenate([rings, rings[:1]]), wedges)
    return loft(rings, parts, closed=True)
