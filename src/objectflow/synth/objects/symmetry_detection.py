"""Find the rotation axes of a mesh: C2 to C12 and continuous, alone or together (cylinder, box, cube, ball).

Every rotation axis of a surface runs through its centroid and lies along principal directions of its second moment
as far as those are unique; only where two or three moments agree is there a plane or a sphere of directions to search.
A candidate is refined by matching the turned surface with itself, then judged by the distance between the two.
"""

from __future__ import annotations

import numpy as np
from numpy.random import Generator
from scipy.spatial import cKDTree

from objectflow.geometry.se3 import kabsch, rotation_angle, so3_exp, so3_log
from objectflow.geometry.symmetry import SymmetryAxis
from objectflow.synth.objects.shapes.solid import surface_center
from objectflow.typing import Float64Array, Int64Array, LabelImage

MAX_ORDER = 12
_ODD_TURNS = np.deg2rad([17.0, 43.0, 101.0, 163.0])
"""Turns that no group up to C12 holds: a surface that stands them all is continuous."""
_QUANTILE = 0.985
"""Share of the surface that must come to lie on itself: a smaller detail does not count."""
_EQUAL_MOMENTS = 0.05
"""Principal moments that differ by less, as a share of the largest, leave their directions open."""
_LARGEST_GROUP = 60
"""The icosahedron's: turns that generate more are no finite group of a solid."""
_SAME_TURN = np.deg2rad(10.0)
_NEIGHBOURS = 12
"""Samples whose triangles are tried: enough to see both sides of a thin wall."""
_SAME_AXIS = np.cos(np.deg2rad(6.0))


def detect(vertices: Float64Array, faces: LabelImage, tolerance: float = 0.01) -> tuple[SymmetryAxis, ...]:
    """The rotation axes of a surface, each with its highest order, all through `surface_center`.

    Args:
        vertices: (V, 3); any unit, any origin.
        faces: (F, 3); the mesh may be open or inside out.
        tolerance: how far the turned surface may lie from the original, as a share of the object's radius.

    Returns:
        All axes of a finite group; for a continuous axis that can be turned over, the axis and one C2 axis across it;
        for a ball, three continuous axes. Empty without symmetry.
    """
    center = surface_center(vertices, faces)
    surface = _Surface((vertices - center)[faces], np.random.default_rng(0), tolerance)
    moments, directions = np.linalg.eigh(surface.second_moment)
    equal = np.diff(moments) < _EQUAL_MOMENTS * moments[-1]
    found = _Axes()
    for direction in directions.T:
        found.add(direction, surface)
    if found.continuous < 2:
        if equal.all():
            for order in (2, 3):
                _search(_half_sphere(1200), order, surface, found)
        elif equal.any():
            plane = directions[:, :2] if equal[0] else directions[:, 1:]
            angle = np.pi * np.arange(90) / 90
            _search(np.cos(angle)[:, None] * plane[:, 0] + np.sin(angle)[:, None] * plane[:, 1], 2, surface, found)
    return found.group()


class _Axes:
    """The axes found so far, without duplicates."""

    def __init__(self) -> None:
        self._found: list[tuple[Float64Array, int]] = []
        self._implied: list[tuple[Float64Array, int]] = []

    @property
    def continuous(self) -> int:
        return sum(order == 0 for _, order in self._found)

    def add(self, axis: Float64Array, surface: _Surface, hint: int | None = None) -> None:
        """Take an axis in if the surface turns about it; `hint` is the order to refine it by."""
        known = self._implied if hint else self._found  # a principal axis may have a higher order than others imply
        if _listed(axis, known):
            return
        refined = surface.refined(axis, hint or 2)
        for trial in (refined,) if hint else (refined, axis):  # a principal direction may be exact already
            order = surface.order(trial)
            if order is not None and not _listed(trial, known):
                self._found.append((trial, order))
                self._implied = list(self._found) if self.continuous else _completed(self._found)
                return

    def group(self) -> tuple[SymmetryAxis, ...]:
        """Close the list: an axis turned about another is an axis of the same order."""
        spinning = [axis for axis, order in self._found if order == 0]
        if len(spinning) > 1:
            return tuple(SymmetryAxis(axis, 0) for axis in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)))
        if spinning:
            across = [axis for axis, order in self._found if order and abs(axis @ spinning[0]) < 1 - _SAME_AXIS + 0.1]
            flip = across[0] - (across[0] @ spinning[0]) * spinning[0] if across else None
            axes = [(spinning[0], 0)] + ([(flip / np.linalg.norm(flip), 2)] if flip is not None else [])
            return tuple(_symmetry_axis(*item) for item in axes)
        return tuple(_symmetry_axis(*item) for item in sorted(self._implied, key=lambda item: -item[1]))


def _listed(axis: Float64Array, axes: list[tuple[Float64Array, int]]) -> bool:
    return any(abs(axis @ other) > _SAME_AXIS for other, _ in axes)


def _completed(found: list[tuple[Float64Array, int]]) -> list[tuple[Float64Array, int]]:
    """All axes of the finite group that some axes generate: multiply its turns until nothing new comes out."""
    generators = [so3_exp(2 * np.pi / order * axis) for axis, order in found]
    group = [np.eye(3)]
    for element in group:  # grows while it is walked
        for generator in generators:
            product = generator @ element
            # The trace of product @ g.T is 1 + 2 cos of the angle between the two.
            nearest = max(float((product * g).sum()) for g in group)
            if len(group) < _LARGEST_GROUP and nearest < 1 + 2 * np.cos(_SAME_TURN):
                group.append(product)
    out = list(found)
    for element in group[1:]:
        axis = so3_log(element) / rotation_angle(element)
        if not any(abs(axis @ seen) > _SAME_AXIS for seen, _ in out):
            out.append((axis, 1 + sum(_turns_about(g, axis) for g in group[1:])))
    return out


def _turns_about(rotation: Float64Array, axis: Float64Array) -> bool:
    return bool(abs(so3_log(rotation) @ axis) > _SAME_AXIS * rotation_angle(rotation))


def _symmetry_axis(axis: Float64Array, order: int) -> SymmetryAxis:
    largest = axis[np.argmax(np.abs(axis) > 0.9 * np.abs(axis).max())]
    x, y, z = (axis if largest > 0 else -axis) + 0.0
    return SymmetryAxis((float(x), float(y), float(z)), order)


def _half_sphere(count: int) -> Float64Array:
    """(count, 3) directions spread evenly over half a sphere (a Fibonacci lattice)."""
    i = np.arange(count)
    z = (i + 0.5) / count
    angle = i * np.pi * (3 - np.sqrt(5))
    r = np.sqrt(1 - z**2)
    return np.stack([r * np.cos(angle), r * np.sin(angle), z], axis=1)


def _search(directions: Float64Array, order: int, surface: _Surface, found: _Axes) -> None:
    """Try the directions about which the surface misses itself least."""
    misses = [surface.quick_miss(direction, order) for direction in directions]
    tried: list[Float64Array] = []
    for i in np.argsort(misses, kind="stable"):
        if len(tried) >= 12 or misses[i] > 0.08 or found.continuous > 1:
            return
        if all(abs(directions[i] @ other) < np.cos(np.deg2rad(9)) for other in tried):
            tried.append(directions[i])
            found.add(directions[i], surface, order)
            if order == 2 and found.continuous == 1 and len(tried) >= 3:
                return  # one turn-over axis stands for all


class _Surface:
    """A centred mesh that can be compared with turned copies of itself; lengths in units of its radius."""

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
        """Points spread over the surface by area, and the triangle of each; evenly along the list of triangles."""
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
        """(Q, 3) -> (Q, 3): the nearest point of the triangles that own the nearest few samples."""
        _, near = self._tree.query(points, k=_NEIGHBOURS)
        candidates = closest_on_triangles(points[:, None], self._triangles[self._owner[near]])
        best = np.linalg.norm(candidates - points[:, None], axis=-1).argmin(axis=1)
        return np.asarray(candidates[np.arange(len(points)), best])

    def quick_miss(self, axis: Float64Array, order: int) -> float:
        """Mean distance between a few turned points and the surface's samples: cheap, good for ranking only."""
        distance, _ = self._tree.query(self._few[:100] @ so3_exp(2 * np.pi / order * axis).T)
        return float(np.mean(distance))

    def _miss(self, axis: Float64Array, angle: float) -> float:
        """How far the surface turned by `angle` is from being the surface again; rough where it is hopeless."""
        R = so3_exp(angle * axis)
        miss = 0.0
        for points in (self._few, self._query):
            turned = points @ R.T
            miss = float(np.quantile(np.linalg.norm(self._closest(turned) - turned, axis=1), _QUANTILE))
            if miss > 2 * self._tolerance:
                break
        return miss

    def order(self, axis: Float64Array) -> int | None:
        """0 for continuous, the highest n <= 12 for C_n, None for no symmetry about this axis."""
        if all(self._miss(axis, angle) <= self._tolerance for angle in _ODD_TURNS):
            return 0
        misses = {n: self._miss(axis, 2 * np.pi / n) for n in range(2, MAX_ORDER + 1)}
        # A shallow C6 nearly stands a seventh of a turn: only orders that fit as well as the best count.
        limit = min(self._tolerance, min(misses.values()) + 0.15 * self._tolerance)
        return max((n for n, miss in misses.items() if miss <= limit), default=None)

    def refined(self, axis: Float64Array, order: int) -> Float64Array:
        """The axis of the rotation near C_n about `axis` that fits the surface to itself best (ICP, trimmed)."""
        points = self._query[:400]
        R = so3_exp(2 * np.pi / order * axis)
        for _ in range(8):
            turned = points @ R.T
            target = self._closest(turned)
            miss = np.linalg.norm(target - turned, axis=1)
            keep = miss <= np.quantile(miss, 0.9)
            # Both clouds with their mirror images through the centre: the fit then has no translation to choose.
            source, goal = np.concatenate([turned[keep], -turned[keep]]), np.concatenate([target[keep], -target[keep]])
            R = kabsch(source, goal)[0][:3, :3] @ R
        vector = so3_log(R)
        length = np.linalg.norm(vector)
        return axis if length < 0.1 else np.asarray(vector / length * np.sign(vector @ axis or 1.0))


def closest_on_triangles(points: Float64Array, triangles: Float64Array) -> Float64Array:
    """The point of each triangle (..., 3, 3) nearest to each point (..., 3); shapes broadcast."""
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
