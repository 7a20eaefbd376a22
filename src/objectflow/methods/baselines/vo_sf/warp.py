"""Warps of the second frame to the first: forward by one motion (splatting), or backward by a motion per pixel."""

from __future__ import annotations

import numpy as np

from objectflow.methods.baselines.vo_sf.pyramid import Level, make_level
from objectflow.typing import Float32Array, Float64Array

_ON_PIXEL = 0.05
"""Distance to a pixel centre below which a point is assigned to that pixel only, pixels."""
_EDGE = 0.3
"""Depth step above which there is no interpolation, metres."""


def splat_second(second: Level, first_T_second: Float64Array) -> Level:
    """Warp the second frame forward by one motion; pixels average the points that project to them.

    Occlusions are not resolved. Weights are those of the paper's program, the squared bilinear weight along u plus
    that along v. The result has holes.
    """
    camera, (rows, columns) = second.camera, second.depth.shape
    valid = second.depth > 0
    points = _move(first_T_second, second.points[valid])
    gray, z = second.gray[valid], points[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        u = np.float32(camera.fx) * points[:, 0] / z + np.float32(camera.cx)
        v = np.float32(camera.fy) * points[:, 1] / z + np.float32(camera.cy)
        inside = (z > 0) & (u >= 0) & (u < columns - 1) & (v >= 0) & (v < rows - 1)
    u, v, gray, z = u[inside], v[inside], gray[inside], z[inside]
    u0, v0 = u.astype(np.intp), v.astype(np.intp)
    du, dv = u - u0, v - v0
    on_pixel = np.abs(du - np.rint(du)) + np.abs(dv - np.rint(dv)) < _ON_PIXEL
    targets, weights = [], []
    for right in (0, 1):
        for down in (0, 1):
            weight_u, weight_v = (du if right else 1 - du), (dv if down else 1 - dv)
            nearest = (weight_u > 0.5) & (weight_v > 0.5)
            weights.append(np.where(on_pixel, nearest.astype(np.float32), weight_u**2 + weight_v**2))
            targets.append((v0 + down) * columns + u0 + right)
    target, weight = np.concatenate(targets), np.concatenate(weights)
    total = np.bincount(target, weight, rows * columns)
    divisor = np.where(total > 0, total, 1)

    def average(values: Float32Array) -> Float32Array:
        mean = np.bincount(target, weight * np.tile(values, 4), rows * columns) / divisor
        return mean.reshape(rows, columns).astype(np.float32)

    return make_level(average(gray), average(z), camera)


def warp_second(second: Level, first: Level, second_T_first: Float32Array) -> Level:
    """Warp the second frame backward: sample it at the projections of the first frame's moved points.

    Args:
        second: the frame that is sampled.
        first: the frame whose points are moved.
        second_T_first: (H, W, 3, 4) motion of each pixel, whose change of depth is subtracted from the samples.

    Returns:
        A level on the first frame's pixels; depth is 0 outside the image and at holes.
    """
    camera, (rows, columns) = second.camera, second.depth.shape
    moved = np.einsum("hwij,hwj->hwi", second_T_first[..., :3], first.points) + second_T_first[..., 3]
    in_view = (first.depth > 0) & (moved[..., 2] > 0)
    z = np.where(in_view, moved[..., 2], 1)
    u = np.float32(camera.fx) * moved[..., 0] / z + np.float32(camera.cx)
    v = np.float32(camera.fy) * moved[..., 1] / z + np.float32(camera.cy)
    in_view &= (u > 0) & (u < columns - 1) & (v > 0) & (v < rows - 1)
    u, v = np.where(in_view, u, 0), np.where(in_view, v, 0)
    u0, v0 = u.astype(np.intp), v.astype(np.intp)
    du, dv = (u - u0).astype(np.float32), (v - v0).astype(np.float32)
    corners = (v0, u0), (v0 + 1, u0), (v0, u0 + 1), (v0 + 1, u0 + 1)
    depths, grays = [second.depth[i] for i in corners], [second.gray[i] for i in corners]
    weights = [(1 - du) * (1 - dv), (1 - du) * dv, du * (1 - dv), du * dv]
    steps = sum(np.abs(depths[i] - depths[i + 1]) for i in range(3))
    # Below 0.3 m the step to a hole is smaller than the limit, so holes are tested separately.
    edge = (steps > _EDGE) | (np.minimum.reduce(depths) == 0)
    nearest = np.rint(dv).astype(np.intp) + v0, np.rint(du).astype(np.intp) + u0
    depth = np.where(edge, second.depth[nearest], sum(w * d for w, d in zip(weights, depths, strict=True)))
    gray = np.where(edge, second.gray[nearest], sum(w * g for w, g in zip(weights, grays, strict=True)))
    valid = in_view & (depth > 0)
    depth = np.where(valid, depth - (moved[..., 2] - first.depth), 0)
    return make_level(np.where(valid, gray, 0).astype(np.float32), np.maximum(depth, 0).astype(np.float32), camera)


def _move(a_T_b: Float64Array, points: Float32Array) -> Float32Array:
    T = a_T_b.astype(np.float32)
    return np.asarray(points @ T[:3, :3].T + T[:3, 3])
