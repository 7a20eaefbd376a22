"""A closed solid with texture coordinates and convex parts, made by lofting rings."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from objectflow.typing import Float64Array, LabelImage


@dataclass(frozen=True, eq=False)
class Solid:
    """One or several closed surfaces, and the convex hulls that represent them in collisions. Metres."""

    vertices: Float64Array
    """(V, 3)."""
    faces: LabelImage
    """(F, 3), counter-clockwise from outside."""
    uv: Float64Array
    """(V, 2) in [0, 1]."""
    parts: tuple[Float64Array, ...]
    """Each (P, 3): points whose convex hull is one part."""

    def moved(self, offset: ArrayLike = (0, 0, 0), rotation: ArrayLike | None = None) -> Solid:
        """The solid rotated by `rotation` (3, 3) about the origin and then shifted by `offset` (3,) metres."""
        R = np.eye(3) if rotation is None else np.asarray(rotation, dtype=np.float64)
        t = np.asarray(offset, dtype=np.float64)
        return Solid(self.vertices @ R.T + t, self.faces, self.uv, tuple(part @ R.T + t for part in self.parts))


def join(solids: Iterable[Solid]) -> Solid:
    """Combine several solids, which may overlap, into one."""
    solids = list(solids)
    starts = np.cumsum([0, *(len(solid.vertices) for solid in solids[:-1])])
    return Solid(
        np.concatenate([solid.vertices for solid in solids]),
        np.concatenate([solid.faces + start for solid, start in zip(solids, starts, strict=True)]).astype(np.int32),
        np.concatenate([solid.uv for solid in solids]),
        tuple(part for solid in solids for part in solid.parts),
    )


def loft(
    rings: Float64Array,
    parts: Iterable[Float64Array],
    start_tip: ArrayLike | None = None,
    end_tip: ArrayLike | None = None,
    closed: bool = False,
) -> Solid:
    """Skin a sequence of rings, and close both ends with fans.

    Args:
        rings: (M, K, 3) metres, all with the same orientation. The end rings must be star-shaped about their tips.
        parts: the convex parts.
        start_tip, end_tip: (3,) centres of the fans, metres; None for the mean of the end ring.
        closed: connect the last ring to the first (a torus) instead of adding fans.
    """
    K = rings.shape[1]
    grid = np.concatenate([rings, rings[:, :1]], axis=1)  # the seam has two copies, u = 0 and u = 1
    if closed:
        grid = np.concatenate([grid, grid[:1]])
    rows = len(grid)
    a = (np.arange(rows - 1)[:, None] * (K + 1) + np.arange(K)[None, :]).ravel()
    b, c, d = a + 1, a + K + 2, a + K + 1
    vertices, count = [grid.reshape(-1, 3)], rows * (K + 1)
    faces = [np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)]
    fans = []
    if not closed:
        for ring, tip, side in ((rings[0], start_tip, -1), (rings[-1], end_tip, 1)):
            center = ring.mean(axis=0) if tip is None else np.asarray(tip, dtype=np.float64)
            vertices += [ring, center[None]]
            i = count + np.arange(K)
            faces.append(np.stack([i, np.roll(i, -1), np.full(K, count + K)], axis=1)[:, ::side])
            fans.append((ring, center, side))
            count += K + 1
    points, triangles = np.concatenate(vertices), np.concatenate(faces).astype(np.int32)
    inside_out = signed_volume(points, triangles) < 0
    if inside_out:
        triangles = np.ascontiguousarray(triangles[:, ::-1])
    u, v = _fractions(grid.mean(axis=0)), _fractions(grid[:, 0])
    sense = -1 if inside_out else 1  # a texture must not be mirrored
    wall = np.stack(np.broadcast_arrays((u if sense > 0 else 1 - u)[None, :], v[:, None]), axis=-1).reshape(-1, 2)
    uv = np.concatenate([wall, *(_disc_uv(ring, center, side * sense) for ring, center, side in fans)])
    return Solid(points, triangles, uv, tuple(parts))


def signed_volume(vertices: Float64Array, faces: LabelImage) -> float:
    """Volume enclosed by a surface, cubic metres; negative if it is inside out."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6)


def surface_center(vertices: Float64Array, faces: LabelImage) -> Float64Array:
    """(3,) centroid of an open or closed surface. Every rotation axis of the surface passes through it."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    return np.asarray((area[:, None] * (a + b + c)).sum(axis=0) / (3 * area.sum()))


def _fractions(line: Float64Array) -> Float64Array:
    """(N, 3) polyline -> (N,) share of its length up to each point."""
    steps = np.linalg.norm(np.diff(line, axis=0), axis=1)
    total = steps.sum()
    covered = np.concatenate([[0.0], np.cumsum(steps)])
    return covered / total if total > 0 else np.linspace(0, 1, len(line))


def _disc_uv(ring: Float64Array, center: Float64Array, sense: int) -> Float64Array:
    """Texture coordinates of a fan, aligned with its longest side: (K + 1, 2), the centre last.

    `sense` is 1 if the ring is counter-clockwise seen from outside, otherwise -1.
    """
    spokes = ring - center
    sides = np.roll(ring, -1, axis=0) - ring
    lengths = np.linalg.norm(sides, axis=1)
    longest = int(np.argmax(lengths > 0.999 * lengths.max()))  # the first of all that are equal up to rounding
    x = sides[longest] / lengths[longest]
    normal = sense * np.cross(spokes, np.roll(spokes, -1, axis=0)).sum(axis=0)
    y = np.cross(normal / np.linalg.norm(normal), x)
    flat = np.stack([spokes @ x, spokes @ y], axis=1)
    return np.concatenate([0.5 + 0.5 * flat / np.abs(flat).max(), [[0.5, 0.5]]])
