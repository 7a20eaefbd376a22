"""Depth, colour and mask of a volume as a camera sees it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from objectflow.geometry.camera import Camera
from objectflow.tracking.volume_grid import VolumeGrid
from objectflow.tracking.volume_surface import SurfacePoints
from objectflow.typing import BoolMask, Float32Array, Float64Array, IndexArray, UInt8Array

MAX_RADIUS = 8
"""Pixels: largest half width of a splat, for volumes directly in front of the camera."""
SEARCH = (-1.5, 6.0)
"""Voxels in front of and behind a splat between which the surface is searched. Splats are squares that face the
camera, so an oblique surface lies behind them."""
SAMPLES = 11
"""Number of samples of the signed distance along a ray, less than a voxel apart."""

MIN_SHARE = 0.2
"""Smallest share of the interpolation between eight voxels that measured ones must have."""


class Rendering(NamedTuple):
    """A rendered volume.

    Attributes:
        depth: (H, W) float32 metres, 0 where the surface is not seen.
        color: (H, W, 3) uint8 RGB.
        valid: (H, W) bool: pixels that show the surface.
    """

    depth: Float32Array
    color: UInt8Array
    valid: BoolMask


def render_volume(
    grid: VolumeGrid | None,
    surface: SurfacePoints,
    truncation: float,
    camera: Camera,
    camera_T_object: Float64Array,
) -> Rendering:
    """Splat the surface points that face the camera, then find the surface on each covered ray.

    Args:
        grid: the voxels; None for an empty picture.
        surface: its zero crossings.
        truncation: metres.
        camera: renders.
        camera_T_object: (4, 4) pose of the object in the camera frame.
    """
    shape = (camera.height, camera.width)
    depth, color = np.zeros(shape, np.float32), np.zeros((*shape, 3), np.uint8)
    if grid is None or not len(surface.points):
        return Rendering(depth, color, depth > 0)
    R, t = camera_T_object[:3, :3].astype(np.float32), camera_T_object[:3, 3].astype(np.float32)
    points = surface.points @ R.T + t
    facing = ((surface.normals @ R.T) * points).sum(axis=1) < 0
    front = np.flatnonzero(facing & (points[:, 2] > 1e-3))
    nearest, owner = _splat(points[front], grid.voxel, camera)
    pixel = np.flatnonzero(owner >= 0)
    z, hit, position = _refine(grid, truncation, camera, camera_T_object, pixel, nearest[pixel])
    depth.reshape(-1)[pixel[hit]] = z[hit]
    owner = front[owner[pixel[hit]]]
    # The colour of the splat would be that of a neighbouring point, always toward the same side.
    shade = _weighted_mean(grid, grid.color.reshape(-1, 3), position[hit])
    shade = np.where(np.isfinite(shade), shade, surface.colors[owner])
    color.reshape(-1, 3)[pixel[hit]] = np.clip(np.rint(shade), 0, 255).astype(np.uint8)
    return Rendering(depth, color, depth > 0)


def _splat(points: Float32Array, voxel: float, camera: Camera) -> tuple[Float32Array, IndexArray]:
    """Depth and index of the nearest point (N, 3) whose square covers each pixel; flat, -1 = none."""
    size = camera.width * camera.height
    depth, owner = np.full(size, np.inf, np.float32), np.full(size, -1, np.intp)
    if not len(points):
        return depth, owner
    z = points[:, 2]
    column = np.rint(points[:, 0] / z * camera.fx + camera.cx).astype(np.intp)
    row = np.rint(points[:, 1] / z * camera.fy + camera.cy).astype(np.intp)
    # From far to near: the assignment of the nearest point to a pixel is the last one.
    order = np.argsort(-z, kind="stable")
    reach = np.clip(np.ceil(0.7 * voxel * max(camera.fx, camera.fy) / z).astype(np.intp), 0, MAX_RADIUS)
    largest = int(reach.max())
    for dv in range(-largest, largest + 1):
        for du in range(-largest, largest + 1):
            x, y = column[order] + du, row[order] + dv
            inside = (x >= 0) & (y >= 0) & (x < camera.width) & (y < camera.height)
            inside &= reach[order] >= max(abs(du), abs(dv))
            target, who = (y * camera.width + x)[inside], order[inside]
            # The order makes the last assignment the nearest point of this offset.
            candidate = np.full(size, -1, np.intp)
            candidate[target] = who
            touched = np.flatnonzero(candidate >= 0)
            nearer = touched[z[candidate[touched]] < depth[touched]]
            owner[nearer] = candidate[nearer]
            depth[nearer] = z[owner[nearer]]
    return depth, owner


def _refine(
    grid: VolumeGrid,
    truncation: float,
    camera: Camera,
    camera_T_object: Float64Array,
    pixel: IndexArray,
    start: Float32Array,
) -> tuple[Float32Array, BoolMask, Float32Array]:
    """The first crossing of each ray with the surface near a splat's depth.

    Args:
        grid: the voxels.
        truncation: metres.
        camera: of the rays.
        camera_T_object: (4, 4).
        pixel: (N,) flat indices of the pixels.
        start: (N,) metres: depth of the splat on each.

    Returns:
        (N,) metres: depth; (N,) whether there is a crossing; (N, 3) its fractional voxel index.
    """
    x = ((pixel % camera.width - camera.cx) / camera.fx).astype(np.float32)
    y = ((pixel // camera.width - camera.cy) / camera.fy).astype(np.float32)
    rays = np.stack([x, y, np.ones_like(x)], axis=1)
    R, t = camera_T_object[:3, :3], camera_T_object[:3, 3]
    # Voxel coordinates along a ray are linear in its depth.
    slope = (rays @ R / grid.voxel).astype(np.float32)
    offset = (-(R.T @ t) / grid.voxel - grid.first - 0.5).astype(np.float32)
    reach = np.linspace(*SEARCH, SAMPLES, dtype=np.float32) * np.float32(grid.voxel)
    depths = start[:, None] + reach
    values = _sample(grid, truncation, depths[..., None] * slope[:, None] + offset)
    before, after = values[:, :-1], values[:, 1:]
    crossing = (before >= 0) & (after < 0)
    step = crossing.argmax(axis=1)
    rows = np.arange(len(pixel))
    hit = crossing[rows, step]
    a, b = before[rows, step], after[rows, step]
    with np.errstate(invalid="ignore", divide="ignore"):
        share = np.where(hit, a / (a - b), 0)
    z = depths[rows, step] + share.astype(np.float32) * (depths[:, 1] - depths[:, 0])
    return z, hit, z[:, None] * slope + offset


def _sample(grid: VolumeGrid, truncation: float, position: Float32Array) -> Float32Array:
    """Signed distance at fractional voxel indices (N, K, 3); NaN where too little around was measured."""
    flat = position.reshape(-1, 3)
    values = _weighted_mean(grid, grid.values(truncation).reshape(-1, 1), flat)
    return values.reshape(position.shape[:-1])


def _weighted_mean(grid: VolumeGrid, values: Float32Array, position: Float32Array) -> Float32Array:
    """Trilinear interpolation between measured voxels.

    Args:
        grid: the voxels.
        values: (X Y Z, C) of the voxels.
        position: (N, 3) fractional voxel indices.

    Returns:
        (N, C); NaN where the measured voxels around have less than a fifth of the interpolation's weight.
    """
    base = np.floor(position)
    fraction = position - base
    corner = base.astype(np.intp)
    total = np.zeros((len(position), values.shape[1]), np.float32)
    weight = np.zeros(len(position), np.float32)
    shape, measured = grid.shape, grid.weight.reshape(-1)
    for offset in np.ndindex(2, 2, 2):
        at = corner + np.array(offset)
        inside = ((at >= 0) & (at < shape)).all(axis=1)
        flat = np.where(inside, (at[:, 0] * shape[1] + at[:, 1]) * shape[2] + at[:, 2], 0)
        share = np.abs(np.float32(1) - np.array(offset, np.float32) - fraction).prod(axis=1)
        share *= inside & (measured[flat] > 0)
        total += share[:, None] * values[flat]
        weight += share
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(weight > MIN_SHARE, total.T / weight, np.float32(np.nan)).T
