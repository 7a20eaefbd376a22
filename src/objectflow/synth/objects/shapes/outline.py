"""Plane curves: closed outlines (sections of a solid) and open profiles (of solids of revolution)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from objectflow.typing import Float64Array


def circle(sides: int = 40) -> Float64Array:
    """(sides, 2) unit circle, counter-clockwise from +x."""
    return superellipse(sides, 2.0)


def superellipse(sides: int, exponent: float, aspect: float = 1.0) -> Float64Array:
    """(sides, 2) points at equal angles on |x|^p + |y / aspect|^p = 1; p = 2 is an ellipse, larger p is squarer."""
    angle = 2 * np.pi * np.arange(sides) / sides
    c, s = np.cos(angle), np.sin(angle)
    r = (np.abs(c) ** exponent + np.abs(s) ** exponent) ** (-1 / exponent)
    return np.stack([r * c, r * s * aspect], axis=1)


def fluted(sides: int, lobes: int, depth: float) -> Float64Array:
    """(sides, 2) circle of mean radius 1 with `lobes` waves of amplitude `depth`; `sides` a multiple of `lobes`."""
    angle = 2 * np.pi * np.arange(sides) / sides
    return (1 + depth * np.cos(lobes * angle))[:, None] * circle(sides)


def polygon(corners: int, per_side: int = 1) -> Float64Array:
    """(corners * per_side, 2) regular polygon with its corners on the unit circle, one of them on +x."""
    angle = 2 * np.pi * np.arange(corners) / corners
    points = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    share = np.arange(per_side)[:, None] / per_side
    return np.concatenate([p + share * (q - p) for p, q in zip(points, np.roll(points, -1, axis=0), strict=True)])


def rectangle(width: float, depth: float, corner: float = 0.0, steps: int = 4) -> Float64Array:
    """Rectangle centred on the origin, its corners rounded by quarter circles of radius `corner`. Metres.

    Returns (4, 2), or (4 * (steps + 1), 2) if rounded. A rotation by 180 degrees (90 for a square) maps points to
    points.
    """
    x, y = width / 2 - corner, depth / 2 - corner
    centers = np.array([[x, y], [-x, y], [-x, -y], [x, -y]])
    if corner <= 0:
        return centers
    angle = np.pi / 2 * (np.arange(4)[:, None] + np.linspace(0, 1, steps + 1)[None, :])
    return np.asarray((centers[:, None] + corner * np.stack([np.cos(angle), np.sin(angle)], axis=-1)).reshape(-1, 2))


def rounded(points: ArrayLike, radii: float | Sequence[float], steps: int = 3) -> Float64Array:
    """(N, D) polyline -> the same polyline with its inner corners replaced by quadratic curves.

    Args:
        points: (N, D) metres.
        radii: distance from the corner to the start of the curve, metres: one for all, or one for each of the N - 2
            inner corners. Limited to 0.45 of the shorter adjacent side; 0 keeps the corner sharp.
        steps: number of segments per curve.
    """
    p = np.asarray(points, dtype=np.float64)
    r = np.broadcast_to(np.asarray(radii, dtype=np.float64), (len(p) - 2,))
    out = [p[:1]]
    for before, corner, after, radius in zip(p[:-2], p[1:-1], p[2:], r, strict=True):
        back, ahead = before - corner, after - corner
        length_back, length_ahead = np.linalg.norm(back), np.linalg.norm(ahead)
        cut = min(radius, 0.45 * min(length_back, length_ahead))
        if cut <= 0:
            out.append(corner[None])
            continue
        start, end = corner + back * (cut / length_back), corner + ahead * (cut / length_ahead)
        s = np.linspace(0, 1, steps + 1)[:, None]
        out.append((1 - s) ** 2 * start + 2 * s * (1 - s) * corner + s**2 * end)
    out.append(p[-1:])
    return np.concatenate(out)


def offset_inwards(profile: Float64Array, distance: float) -> Float64Array:
    """Inner wall of a vessel: the upward outer profile (N, 2), shifted to its left by `distance` metres."""
    direction = np.diff(profile, axis=0)
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    normal = np.stack([-direction[:, 1], direction[:, 0]], axis=1)
    before, after = np.concatenate([normal[:1], normal]), np.concatenate([normal, normal[-1:]])
    bisector = before + after
    bisector /= np.linalg.norm(bisector, axis=1, keepdims=True)
    stretch = 1 / np.maximum((bisector * after).sum(axis=1), 0.65)  # a mitre, limited at sharp corners
    return np.asarray(profile + distance * stretch[:, None] * bisector)


def inset(outline: Float64Array, distance: float) -> Float64Array:
    """Shift every side of a convex, counter-clockwise outline (K, 2) inwards by `distance` metres."""
    sides = np.roll(outline, -1, axis=0) - outline
    after = np.stack([-sides[:, 1], sides[:, 0]], axis=1) / np.linalg.norm(sides, axis=1, keepdims=True)
    before = np.roll(after, 1, axis=0)
    shift = (before + after) / (1 + (before * after).sum(axis=1, keepdims=True))
    return np.asarray(outline + distance * shift)
