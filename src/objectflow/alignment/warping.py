"""Warping with occlusion: sampling the previous frame at the current frame's points, and splatting into an image."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from objectflow import geometry
from objectflow.alignment import matching
from objectflow.errors import GeometryError
from objectflow.frame import RgbdFrame
from objectflow.geometry.camera import Camera
from objectflow.geometry.resample import sample_bilinear
from objectflow.typing import BoolMask, Float32Array, UInt8Array

_EMPTY = np.uint64(2**64 - 1)
"""Value of empty pixels in the depth buffer of `splat`."""


@dataclass(frozen=True, eq=False)
class Warped:
    """The previous frame, warped to the pixels of the current frame.

    Attributes:
        color: (H, W, 3) float32, RGB 0..255; 0 where not visible.
        depth: (H, W) float32, metres in the previous camera's frame; 0 where not visible.
        visible: (H, W) bool, True where the previous frame measured the point, unoccluded.
    """

    color: Float32Array
    depth: Float32Array
    visible: BoolMask


def warp_previous(prev: RgbdFrame, points_in_prev: NDArray[Any], *, tolerance: float | NDArray[Any]) -> Warped:
    """Sample the previous frame at the previous positions of the current frame's points.

    Args:
        prev: the previous frame.
        points_in_prev: (H, W, 3) metres, previous camera frame: the current pixels' points plus their scene flow.
            NaN where unknown. H and W are those of the current frame and may differ from those of the previous frame.
        tolerance: maximum depth difference from the measured surface in metres, a number or (H, W). A nearer surface
            occludes the point; a farther surface contradicts the motion. The point is not visible in either case.

    Returns:
        Bilinear colour, bilinear depth that is not interpolated across depth edges, and visibility.

    Raises:
        GeometryError: the points have another shape, or the tolerance has another shape or is not positive.
    """
    points = np.asarray(points_in_prev)
    if points.ndim != 3 or points.shape[2] != 3:
        raise GeometryError(f"points_in_prev must be (H, W, 3), not {points.shape}")
    limit = np.asarray(tolerance, dtype=np.float64)
    if limit.shape not in ((), points.shape[:2]) or not (limit > 0).all():
        raise GeometryError(f"tolerance must be positive metres, a number or an array of shape {points.shape[:2]}")
    with np.errstate(over="ignore"):
        pixels = geometry.project(points.astype(np.float64), prev.camera).reshape(-1, 2).astype(np.float32)
    measured, ok = matching.sample_depth(prev.depth, pixels)
    shape = points.shape[:2]
    measured, ok = measured.reshape(shape), ok.reshape(shape)
    with np.errstate(invalid="ignore"):
        visible = ok & (np.abs(points[..., 2] - measured) <= limit)
    color = np.zeros((*shape, 3), np.float32)
    color[visible] = sample_bilinear(prev.color, pixels[visible.ravel()])
    return Warped(color=color, depth=np.where(visible, measured, np.float32(0)), visible=visible)


def splat(points: NDArray[Any], color: UInt8Array, camera: Camera) -> tuple[UInt8Array, Float32Array]:
    """Splat coloured points into an image: each point fills one pixel, and the nearest point of a pixel is kept.

    Args:
        points: (..., 3) metres, camera frame; NaN and points behind the camera are ignored.
        color: (..., 3) uint8, one colour per point.
        camera: the camera of the rendered image.

    Returns:
        Colour (H, W, 3) uint8 and planar depth (H, W) float32 in metres; both 0 in holes.

    Raises:
        GeometryError: the shapes of points and colours differ, or are not (..., 3).
    """
    if points.shape != color.shape or points.ndim < 2 or points.shape[-1] != 3:
        raise GeometryError(f"splat needs points and colours of one shape (..., 3), not {points.shape}, {color.shape}")
    flat = points.reshape(-1, 3).astype(np.float64)
    column, row = np.floor(geometry.project(flat, camera) + 0.5).T
    with np.errstate(invalid="ignore"):
        keep = np.flatnonzero((column >= 0) & (row >= 0) & (column < camera.width) & (row < camera.height))
    target = row[keep].astype(np.int64) * camera.width + column[keep].astype(np.int64)
    # Each buffer entry combines depth and point index: the bits of positive floats sort in the order of the floats.
    near = flat[keep, 2].astype(np.float32).view(np.uint32).astype(np.uint64) << np.uint64(32)
    buffer = np.full(camera.height * camera.width, _EMPTY)
    np.minimum.at(buffer, target, near | keep.astype(np.uint64))
    filled = np.flatnonzero(buffer != _EMPTY)
    nearest = (buffer[filled] & np.uint64(0xFFFFFFFF)).astype(np.intp)
    image = np.zeros((camera.height * camera.width, 3), np.uint8)
    depth = np.zeros(camera.height * camera.width, np.float32)
    image[filled] = color.reshape(-1, 3)[nearest]
    depth[filled] = flat[nearest, 2]
    return image.reshape(camera.height, camera.width, 3), depth.reshape(camera.height, camera.width)
