"""The second frame seen from the first: thrown forward by one motion, or fetched back by a motion a pixel."""

from __future__ import annotations

import numpy as np

from objectflow.methods.baselines.vo_sf.pyramid import Level, make_level
from objectflow.typing import Float32Array, Float64Array

_ON_PIXEL = 0.05
"""Pixels: a point that lands this near to a pixel's centre goes there alone."""
_EDGE = 0.3
"""Metres: across a step in depth of this size nothing is interpolated."""


def splat_second(second: Level, first_T_second: Float64Array) -> Level:
    """Move the second frame's points by one motion and average what lands on each pixel: `Level` with holes.

    Averages where nearer and further points land together; their share is that of the paper's program, squared
    closeness along u plus squared closeness along v.
    """
    camera, (rows, columns) = second.camera, second.depth.shape
    seen = second.depth > 0
    points = _move(first_T_second, second.points[seen])
    gray, z = second.gray[seen], points[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        u = np.float32(camera.fx) * points[:, 0] / z + np.float32(camera.cx)
        v = np.float32(camera.fy) * points[:, 1] / z + np.float32(camera.cy)
        inside = (z > 0) & (u >= 0) & (u < columns - 1) & (v >= 0) & (v < rows - 1)
    u, v, gray, z = u[inside], v[inside], gray[inside], z[inside]
    u0, v0 = u.astype(np.intp), v.astype(np.intp)
    du, dv = u - u0, v - v0
    alone = np.abs(du - np.rint(du)) + np.abs(dv - np.rint(dv)) < _ON_PIXEL
    targets, weights = [], []
    for right in (0, 1):
        for down in (0, 1):
            near_u, near_v = (du if right else 1 - du), (dv if down else 1 - dv)
            nearest = (near_u > 0.5) & (near_v > 0.5)
            weights.append(np.where(alone, nearest.astype(np.float32), near_u**2 + near_v**2))
            targets.append((v0 + down) * columns + u0 + right)
    target, weight = np.concatenate(targets), np.concatenate(weights)
    total = np.bincount(target, weight, rows * columns)
    hit = total > 0
    safe = np.where(hit, total, 1)

    def average(values: Float32Array) -> Float32Array:
        mean = np.bincount(target, weight * np.tile(values, 4), rows * columns) / safe
        return mean.reshape(rows, columns).astype(np.float32)

    return make_level(average(gray), average(z), camera)


def fetch_second(second: Level, first: Level, second_T_first: Float32Array) -> Level:
    """Sample the second frame where the first frame's points go, each by its own motion.

    Args:
        second: what is sampled.
        first: whose points are moved.
        second_T_first: (H, W, 3, 4) motions; what they add to the depth is taken off again.

    Returns:
        A level on the first frame's pixels, depth 0 outside the image and on holes.
    """
    camera, (rows, columns) = second.camera, second.depth.shape
    moved = np.einsum("hwij,hwj->hwi", second_T_first[..., :3], first.points) + second_T_first[..., 3]
    seen = (first.depth > 0) & (moved[..., 2] > 0)
    z = np.where(seen, moved[..., 2], 1)
    u = np.float32(camera.fx) * moved[..., 0] / z + np.float32(camera.cx)
    v = np.float32(camera.fy) * moved[..., 1] / z + np.float32(camera.cy)
    seen &= (u > 0) & (u < columns - 1) & (v > 0) & (v < rows - 1)
    u, v = np.where(seen, u, 0), np.where(seen, v, 0)
    u0, v0 = u.astype(np.intp), v.astype(np.intp)
    du, dv = (u - u0).astype(np.float32), (v - v0).astype(np.float32)
    at = (v0, u0), (v0 + 1, u0), (v0, u0 + 1), (v0 + 1, u0 + 1)
    depths, grays = [second.depth[i] for i in at], [second.gray[i] for i in at]
    weights = [(1 - du) * (1 - dv), (1 - du) * dv, du * (1 - dv), du * dv]
    jumps = sum(np.abs(depths[i] - depths[i + 1]) for i in range(3))
    # Nearer than 0.3 m a hole makes no jump of that size.
    edge = (jumps > _EDGE) | (np.minimum.reduce(depths) == 0)
    nearest = np.rint(dv).astype(np.intp) + v0, np.rint(du).astype(np.intp) + u0
    depth = np.where(edge, second.depth[nearest], sum(w * d for w, d in zip(weights, depths, strict=True)))
    gray = np.where(edge, second.gray[nearest], sum(w * g for w, g in zip(weights, grays, strict=True)))
    hit = seen & (depth > 0)
    depth = np.where(hit, depth - (moved[..., 2] - first.depth), 0)
    return make_level(np.where(hit, gray, 0).astype(np.float32), np.maximum(depth, 0).astype(np.float32), camera)


def _move(a_T_b: Float64Array, points: Float32Array) -> Float32Array:
    T = a_T_b.astype(np.float32)
    return np.asarray(points @ T[:3, :3].T + T[:3, 3])
