"""Projection and back-projection of a pinhole camera, and the scene flow of rigid motions."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from objectflow.geometry.camera import Camera
from objectflow.typing import Float32Array, Float64Array, LabelImage


def pixel_rays(camera: Camera) -> tuple[Float32Array, Float32Array]:
    """(W,) `(u - cx) / fx` of every column and (H,) `(v - cy) / fy` of every row, float32."""
    x = (np.arange(camera.width, dtype=np.float32) - np.float32(camera.cx)) / np.float32(camera.fx)
    y = (np.arange(camera.height, dtype=np.float32) - np.float32(camera.cy)) / np.float32(camera.fy)
    return x, y


def pixel_grid(camera: Camera) -> Float32Array:
    """(H, W, 2) float32: `((u - cx) / fx, (v - cy) / fy)` of every pixel centre, the ray at z = 1."""
    return np.stack(np.meshgrid(*pixel_rays(camera)), axis=-1)


def back_project(depth: Float32Array, camera: Camera) -> Float32Array:
    """Planar depth (H, W) in metres -> points (H, W, 3) float32 in the camera frame; NaN where depth is 0."""
    z = np.where(depth > 0, depth, np.float32(np.nan)).astype(np.float32)
    x, y = pixel_rays(camera)
    points = np.empty((*z.shape, 3), np.float32)
    points[..., 0], points[..., 1], points[..., 2] = x * z, y[:, None] * z, z
    return points


def back_project_pixels(pixels: NDArray[Any], depth: NDArray[Any] | np.floating[Any], camera: Camera) -> NDArray[Any]:
    """Pixels (..., 2) as (u, v) and their planar depth (...) in metres -> points (..., 3) in the camera frame."""
    x = (pixels[..., 0] - camera.cx) / camera.fx * depth
    y = (pixels[..., 1] - camera.cy) / camera.fy * depth
    return np.stack([x, y, np.asarray(depth)], axis=-1)


def project(points: NDArray[Any], camera: Camera) -> NDArray[Any]:
    """Points (..., 3) -> pixels (..., 2) as (u, v); NaN for points at or behind the camera plane."""
    z = np.where(points[..., 2] > 1e-6, points[..., 2], np.nan)
    u = points[..., 0] / z * camera.fx + camera.cx
    v = points[..., 1] / z * camera.fy + camera.cy
    return np.stack([u, v], axis=-1).astype(points.dtype, copy=False)


def flow_from_motions(
    points: Float32Array,
    labels: LabelImage,
    motions: dict[int, Float64Array],
    background_prev_T_curr: Float64Array | None = None,
) -> Float32Array:
    """Scene flow `P_prev - P_curr` of rigidly moving regions (equation 1 of the paper).

    Args:
        points: (H, W, 3) metres, NaN where depth is missing.
        labels: (H, W) int32; regions without a motion move like the background.
        motions: label -> (4, 4) `prev_T_curr`.
        background_prev_T_curr: (4, 4) motion of everything else; None for a flow of exactly 0.

    Returns:
        (H, W, 3) float32 metres, NaN where depth is missing.
    """
    if background_prev_T_curr is None:
        flow = np.where(np.isnan(points), points, np.float32(0))
    else:
        flow = _displacement(background_prev_T_curr, points)
    for label, prev_T_curr in motions.items():
        mask = labels == label
        flow[mask] = _displacement(prev_T_curr, points[mask])
    return flow


def _displacement(prev_T_curr: Float64Array, points: Float32Array) -> Float32Array:
    """(R - I) P + t, which keeps small motions exact in float32."""
    A = (prev_T_curr[:3, :3] - np.eye(3)).astype(np.float32)
    return points @ A.T + prev_T_curr[:3, 3].astype(np.float32)
