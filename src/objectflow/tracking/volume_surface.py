"""The surface in a volume: points where the signed distance crosses zero, for registration and rendering."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from objectflow.tracking.volume_grid import VolumeGrid
from objectflow.typing import BoolMask, Float32Array, IndexArray, UInt8Array

MAX_VALUE = 0.95
"""Largest signed distance at either end of a crossing, in truncation distances. A voxel that was only seen through, or
one far behind the surface, does not bound a surface that was seen."""


class SurfacePoints(NamedTuple):
    """Oriented, coloured points.

    Attributes:
        points: (N, 3) float32 metres, in the object frame.
        normals: (N, 3) float32 unit vectors out of the object.
        colors: (N, 3) uint8 RGB.
    """

    points: Float32Array
    normals: Float32Array
    colors: UInt8Array


def measured_voxels(grid: VolumeGrid, values: Float32Array, truncation: float, min_weight: float) -> BoolMask:
    """(X, Y, Z) bool: voxels whose signed distance was measured close to the surface.

    Args:
        grid: the voxels.
        values: its distances, as of `VolumeGrid.values`.
        truncation: metres.
        min_weight: smallest weight of the measurements.
    """
    return (grid.weight >= min_weight) & (np.abs(values) < MAX_VALUE * truncation)


def surface_points(grid: VolumeGrid, truncation: float, min_weight: float) -> SurfacePoints:
    """Interpolate the zero crossings of the signed distance between neighbouring voxels along the three axes.

    Args:
        grid: the voxels.
        truncation: metres.
        min_weight: smallest weight of a voxel.

    Returns:
        The points in an order that depends only on the grid.
    """
    values = grid.values(truncation)
    measured = measured_voxels(grid, values, truncation, min_weight)
    flat, known = values.ravel(), measured.ravel()
    colors = grid.color.reshape(-1, 3)
    strides = (values.shape[1] * values.shape[2], values.shape[2], 1)
    out: list[tuple[Float32Array, Float32Array, Float32Array]] = []
    for axis, stride in enumerate(strides):
        low = tuple(slice(None, -1) if a == axis else slice(None) for a in range(3))
        high = tuple(slice(1, None) if a == axis else slice(None) for a in range(3))
        crossing = measured[low] & measured[high] & ((values[low] < 0) != (values[high] < 0))
        first = np.ravel_multi_index(np.nonzero(crossing), values.shape)
        second = first + stride
        a, b = flat[first], flat[second]
        share = (a / (a - b))[:, None]
        points = grid.centers(first).T.copy()
        points[:, axis] += share[:, 0] * np.float32(grid.voxel)
        # The means of both voxels' slopes.
        slopes = np.stack(
            [_slope(flat, known, first, step) + _slope(flat, known, second, step) for step in strides], axis=1
        )
        out.append((points, slopes, colors[first] * (1 - share) + colors[second] * share))
    points, normals, shades = (np.concatenate(parts) for parts in zip(*out, strict=True))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True) + np.float32(1e-12)
    return SurfacePoints(points, normals, np.clip(np.rint(shades), 0, 255).astype(np.uint8))


def _slope(flat: Float32Array, known: BoolMask, index: IndexArray, stride: int) -> Float32Array:
    """Difference of the distances on both sides of voxels, per voxel; one-sided where a neighbour is unknown."""
    last = len(flat) - 1
    before, after = np.maximum(index - stride, 0), np.minimum(index + stride, last)
    before, after = np.where(known[before], before, index), np.where(known[after], after, index)
    steps = (before != index).astype(np.float32) + (after != index)
    return np.asarray((flat[after] - flat[before]) / np.maximum(steps, 1))
