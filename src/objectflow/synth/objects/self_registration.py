"""Registration of a surface with rotated copies of itself: the order and the exact direction of a symmetry axis."""

from __future__ import annotations

import numpy as np
from numpy.random import Generator
from scipy.spatial import cKDTree

from objectflow.geometry.se3 import kabsch, so3_exp, so3_log
from objectflow.typing import Float64Array, Int64Array

MAX_ORDER = 12
"""Highest order of a finite axis."""
_PROBE_ANGLES = np.deg2rad([17.0, 43.0, 101.0, 163.0])
"""Angles in radians that belong to no group up to C12: an axis with symmetry at all of them is continuous."""
_QUANTILE = 0.985
"""Share of the surface that must match; smaller details are ignored."""
_NEIGHBOURS = 12
"""Number of nearest samples whose triangles are searched; enough for both sides of a thin wall."""


class SampledSurface:
    """A centred mesh that is compared with rotated copies of itself; lengths are in units of its radius."""

    def __init__(self, triangles: Float64Array, rng: Generator, tolerance: float) -> None:
        radius = float(np.linalg.norm(triangles, axis=-1).max())
        self._triangles = triangles / radius
        self._tolerance = tolerance
        first, second = (self._triangles[:, i] - self._triangles[:, 0] for i in (1, 2))
        area = np.linalg.norm(np.cross(first, second), axis=1)
        self._share = area / area.sum()
        total = self._triangles.sum(axis=1)
        weight = self._share[:, None]
        corners = sum((weight * self._triangles[:, i]).T @ self._triangles[:, i] for i in range(3))
        self.second_moment: Float64Array = (corners + (weight * total).T @ total) / 12
        points, self._owner = self._sample(20_000, rng)
        self._tree = cKDTree(points)
        self._query, _ = self._sample(1500, rng)
        self._few = self._query[:250]

    def _sample(self, count: int, rng: Generator) -> tuple[Float64Array, Int64Array]:
        """Area-weighted samples (N, 3), stratified along the list of triangles, and the triangle of each (N,)."""
        edges = np.cumsum(self._share)
        at = (np.arange(count) + rng.random(count)) / count
        owner = np.minimum(np.searchsorted(edges, at * edges[-1]), len(edges) - 1)
        u, v = rng.random((2, count))
        fold = u + v > 1
        u, v = np.where(fold, 1 - u, u), np.where(fold, 1 - v, v)
        a, b, c = (self._triangles[owner, i] for i in range(3))
        points = a + u[:, None] * (b - a) + v[:, None] * (c - a)
        order = rng.permutation(count)
        return points[order], owner[order]

    def _closest(self, points: Float64Array) -> Float64Array:
        """(Q, 3) -> (Q, 3): the closest point on the triangles of the nearest samples."""
        _, near = self._tree.query(points, k=_NEIGHBOURS)
        candidates = closest_on_triangles(points[:, None], self._triangles[self._owner[near]])
        best = np.linalg.norm(candidates - points[:, None], axis=-1).argmin(axis=1)
        return np.asarray(candidates[np.arange(len(points)), best])

    def coarse_distance(self, axis: Float64Array, order: int) -> float:
        """Mean distance between some rotated points and the surface's samples: cheap, suitable only for ranking."""
        distance, _ = self._tree.query(self._few[:100] @ so3_exp(2 * np.pi / order * axis).T)
        return float(np.mean(distance))

    def _distance(self, axis: Float64Array, angle: float) -> float:
        """Distance between the surface rotated by `angle` and the original; approximate far above the tolerance."""
        R = so3_exp(angle * axis)
        distance = 0.0
        for points in (self._few, self._query):
            rotated = points @ R.T
            distance = float(np.quantile(np.linalg.norm(self._closest(rotated) - rotated, axis=1), _QUANTILE))
            if distance > 2 * self._tolerance:
                break
        return distance

    def order(self, axis: Float64Array) -> int | None:
        """0 for a continuous axis, the highest n <= 12 for C_n, None for no symmetry about this axis."""
        if all(self._distance(axis, angle) <= self._tolerance for angle in _PROBE_ANGLES):
            return 0
        distances = {n: self._distance(axis, 2 * np.pi / n) for n in range(2, MAX_ORDER + 1)}
        # A shallow C6 is almost a C7: only orders that fit about as well as the best one are accepted.
        limit = min(self._tolerance, min(distances.values()) + 0.15 * self._tolerance)
        return max((n for n, distance in distances.items() if distance <= limit), default=None)

    def refined(self, axis: Float64Array, order: int) -> Float64Array:
        """The axis of the rotation near C_n about `axis` that best registers the surface with itself (trimmed ICP)."""
        points = self._query[:400]
        R = so3_exp(2 * np.pi / order * axis)
        for _ in range(8):
            rotated = points @ R.T
            target = self._closest(rotated)
            distance = np.linalg.norm(target - rotated, axis=1)
            keep = distance <= np.quantile(distance, 0.9)
            # Point reflections of both clouds are added, so that the estimated translation is zero.
            source = np.concatenate([rotated[keep], -rotated[keep]])
            goal = np.concatenate([target[keep], -target[keep]])
            R = kabsch(source, goal)[0][:3, :3] @ R
        vector = so3_log(R)
        length = np.linalg.norm(vector)
        return axis if length < 0.1 else np.asarray(vector / length * np.sign(vector @ axis or 1.0))


def closest_on_triangles(points: Float64Array, triangles: Float64Array) -> Float64Array:
    """The point of each triangle (..., 3, 3) that is closest to each point (..., 3); shapes broadcast."""
    a, b, c = (triangles[..., i, :] for i in range(3))
    ab, ac, ap = b - a, c - a, points - a
    d00, d01, d11 = _dot(ab, ab), _dot(ab, ac), _dot(ac, ac)
    d20, d21 = _dot(ap, ab), _dot(ap, ac)
    area = np.maximum(d00 * d11 - d01 * d01, 1e-30)
    v, w = (d11 * d20 - d01 * d21) / area, (d00 * d21 - d01 * d20) / area
    inside = (v >= 0) & (w >= 0) & (v + w <= 1) & (d00 * d11 - d01 * d01 > 1e-30)
    best = a + v[..., None] * ab + w[..., None] * ac
    distance = np.where(inside, 0.0, np.inf)
    for start, edge in ((a, ab), (a, ac), (b, c - b)):
        t = np.clip(_dot(points - start, edge) / np.maximum(_dot(edge, edge), 1e-30), 0, 1)
        on_edge = start + t[..., None] * edge
        away = _dot(points - on_edge, points - on_edge)
        closer = away < distance
        best = np.where(closer[..., None], on_edge, best)
        distance = np.where(closer, away, distance)
    return best


def _dot(a: Float64Array, b: Float64Array) -> Float64Array:
    return np.asarray(np.einsum("...i,...i->...", a, b))
