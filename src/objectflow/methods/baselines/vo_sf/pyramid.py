"""The image pyramid: gray, depth and points at five resolutions, downsampled without mixing surfaces."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from objectflow import geometry
from objectflow.alignment.appearance import to_gray
from objectflow.errors import FrameError
from objectflow.frame import MAX_MEDIAN_DEPTH, MIN_MEDIAN_DEPTH, RgbdFrame
from objectflow.geometry.camera import Camera
from objectflow.typing import Float32Array

WIDTH, HEIGHT, LEVELS = 320, 240, 5
"""Size of the finest level in pixels, and number of levels; the coarsest level is 15x20."""

_KERNEL = np.outer([1, 2, 2, 1], [1, 2, 2, 1]).astype(np.float32) / np.float32(36)
_SURFACE = np.float32(0.1)
"""Largest difference to the block's reference depth at which a pixel has a weight, metres."""


@dataclass(frozen=True, eq=False)
class Level:
    """One resolution of one frame.

    Attributes:
        gray: (H, W) float32, 0..1.
        points: (H, W, 3) float32 metres, camera frame; 0 where depth is missing.
        camera: of this resolution.
    """

    gray: Float32Array
    points: Float32Array
    camera: Camera

    @property
    def depth(self) -> Float32Array:
        """(H, W) float32 metres, 0 where missing."""
        return self.points[..., 2]


def make_level(gray: Float32Array, depth: Float32Array, camera: Camera) -> Level:
    """Back-project a level's depth; pixels without depth get the point 0."""
    rays = geometry.pixel_grid(camera)
    points = np.concatenate([rays * depth[..., None], depth[..., None]], axis=-1)
    return Level(gray, points, camera)


def build_pyramid(frame: RgbdFrame) -> list[Level]:
    """Build the levels of a frame, finest (240x320) first.

    Raises:
        FrameError: no pixel has a plausible depth at this resolution.
    """
    frame = frame.resized(WIDTH, HEIGHT)
    gray = to_gray(frame.color).astype(np.float32) / np.float32(255)
    plausible = (frame.depth >= MIN_MEDIAN_DEPTH) & (frame.depth <= MAX_MEDIAN_DEPTH)
    if not plausible.any():
        raise FrameError(
            f"{frame.name}: no depth from 5 mm to 50 m is left at {WIDTH}x{HEIGHT}: check the depth image"
        )
    depth, camera = np.where(plausible, frame.depth, np.float32(0)), frame.camera
    levels = [make_level(gray, depth, camera)]
    for _ in range(LEVELS - 1):
        gray, depth = _halve(gray, depth)
        camera = camera.scaled(camera.width // 2, camera.height // 2)
        levels.append(make_level(gray, depth, camera))
    return levels


def _halve(gray: Float32Array, depth: Float32Array) -> tuple[Float32Array, Float32Array]:
    """Halve both images with a 4x4 binomial-like kernel whose weights decrease with the difference in depth.

    A block's reference depth is the second largest of its central four, which is robust to a single outlier. Plain
    means are used on the image border and, for gray, in blocks without depth.
    """
    rows, columns = depth.shape[0] // 2, depth.shape[1] // 2
    padded_gray, padded_depth = np.pad(gray, 1), np.pad(depth, 1)

    def shifted(image: Float32Array, row: int, column: int) -> Float32Array:
        return image[row : row + 2 * rows : 2, column : column + 2 * columns : 2]

    a, b, c, d = (shifted(padded_depth, i, j) for i in (1, 2) for j in (1, 2))
    reference = np.maximum(
        np.minimum(np.maximum(a, b), np.maximum(c, d)), np.maximum(np.minimum(a, b), np.minimum(c, d))
    )
    total, gray_sum, depth_sum, plain = (np.zeros((rows, columns), np.float32) for _ in range(4))
    for i in range(4):
        for j in range(4):
            z, brightness = shifted(padded_depth, i, j), shifted(padded_gray, i, j)
            weight = _KERNEL[i, j] * np.maximum(_SURFACE - np.abs(z - reference), 0) * (z > 0)
            total += weight
            depth_sum += weight * z
            gray_sum += weight * brightness
            plain += _KERNEL[i, j] * brightness
    known = (reference > 0) & (total > 0)
    divisor = np.where(known, total, 1)
    half_depth = np.where(known, depth_sum / divisor, 0)
    half_gray = np.where(known, gray_sum / divisor, plain)

    four = np.stack([a, b, c, d])
    count = (four > 0).sum(0)
    border = np.ones((rows, columns), bool)
    border[1:-1, 1:-1] = False
    mean_gray = sum(shifted(padded_gray, i, j) for i in (1, 2) for j in (1, 2)) / np.float32(4)
    half_depth = np.where(border, four.sum(0) / np.maximum(count, 1), half_depth)
    half_gray = np.where(border, mean_gray, half_gray)
    return half_gray.astype(np.float32), half_depth.astype(np.float32)
