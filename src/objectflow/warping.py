"""Warping with occlusion: take from the previous frame what the current one shows, or throw points into an image."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from objectflow import correspondence, geometry
from objectflow.errors import GeometryError
from objectflow.frame import Camera, RgbdFrame


@dataclass(frozen=True, eq=False)
class Warped:
    """What the previous frame shows where the current frame's pixels were.

    Attributes:
        color: (H, W, 3) float32, RGB 0..255; 0 where not visible.
        depth: (H, W) float32, metres in the previous camera's frame; 0 where not visible.
        visible: (H, W) bool: the previous frame measured this point, with nothing before it.
    """

    color: NDArray[np.float32]
    depth: NDArray[np.float32]
    visible: NDArray[np.bool_]


def warp_previous(prev: RgbdFrame, points_in_prev: NDArray[Any], *, tolerance: float | NDArray[Any]) -> Warped:
    """Sample the previous frame where the current frame's pixels were.

    Args:
        prev: the previous frame.
        points_in_prev: (H, W, 3) metres, previous camera frame: the current pixels' points plus their scene flow.
            NaN where unknown. H and W are the current frame's and may differ from the previous one's.
        tolerance: metres, a number or (H, W): how far from the measured surface a point may lie. Something nearer
            hides the point; something further says that the motion is wrong there. Neither is visible.

    Returns:
        Colour bilinear, depth bilinear on one surface and not sampled across edges, and what is visible.

    Raises:
        GeometryError: points of another shape, or a tolerance that is not positive or does not fit.
    """
    points = np.asarray(points_in_prev)
    if points.ndim != 3 or points.shape[2] != 3:
        raise GeometryError(f"points_in_prev must be (H, W, 3), not {points.shape}")
    limit = np.asarray(tolerance, dtype=np.float64)
    if limit.shape not in ((), points.shape[:2]) or not (limit > 0).all():
        raise GeometryError(f"tolerance must be a positive number of metres or an array {points.shape[:2]} of them")
    with np.errstate(over="ignore"):
        pixels = geometry.project(points.astype(np.float64), prev.camera).reshape(-1, 2).astype(np.float32)
    measured, ok = correspondence.sample_depth(prev.depth, pixels)
    shape = points.shape[:2]
    measured, ok = measured.reshape(shape), ok.reshape(shape)
    with np.errstate(invalid="ignore"):
        visible = ok & (np.abs(points[..., 2] - measured) <= limit)
    color = np.zeros((*shape, 3), np.float32)
    color[visible] = _bilinear(prev.color, pixels[visible.ravel()])
    return Warped(color=color, depth=np.where(visible, measured, np.float32(0)), visible=visible)


def splat(
    points: NDArray[Any], color: NDArray[np.uint8], camera: Camera
) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Throw coloured points into an image: each into the pixel that it falls in, the nearest of a pixel wins.

    Args:
        points: (..., 3) metres, camera frame; NaN and points behind the camera are left out.
        color: (..., 3) uint8, one for each point.
        camera: of the image to fill.

    Returns:
        Colour (H, W, 3) uint8 and planar depth (H, W) float32 in metres; both 0 in holes.

    Raises:
        GeometryError: shapes that do not fit.
    """
    if points.shape != color.shape or points.ndim < 2 or points.shape[-1] != 3:
        raise GeometryError(f"splat needs points and colours of one shape (..., 3), not {points.shape}, {color.shape}")
    flat = points.reshape(-1, 3).astype(np.float64)
    pixels = geometry.project(flat, camera)
    with np.errstate(invalid="ignore"):
        inside = (pixels >= -0.5).all(1) & (pixels < [camera.width - 0.5, camera.height - 0.5]).all(1)
    keep = np.flatnonzero(inside)
    column, row = np.floor(pixels[keep] + 0.5).astype(int).T
    target = row * camera.width + column
    # Sorted by pixel, then by depth: the first of each pixel is its nearest.
    order = np.lexsort((flat[keep, 2], target))
    filled, first = np.unique(target[order], return_index=True)
    nearest = keep[order[first]]
    image = np.zeros((camera.height * camera.width, 3), np.uint8)
    depth = np.zeros(camera.height * camera.width, np.float32)
    image[filled] = color.reshape(-1, 3)[nearest]
    depth[filled] = flat[nearest, 2]
    return image.reshape(camera.height, camera.width, 3), depth.reshape(camera.height, camera.width)


def _bilinear(image: NDArray[np.uint8], pixels: NDArray[np.float32]) -> NDArray[np.float32]:
    """(H, W, C) at pixels (N, 2) as (u, v) that lie between pixel centres -> (N, C) float32."""
    low = np.minimum(np.floor(pixels).astype(int), [image.shape[1] - 2, image.shape[0] - 2])
    (u, v), (du, dv) = low.T, (pixels - low).T[..., None]
    top = image[v, u] * (1 - du) + image[v, u + 1] * du
    bottom = image[v + 1, u] * (1 - du) + image[v + 1, u + 1] * du
    return np.asarray(top * (1 - dv) + bottom * dv, dtype=np.float32)
