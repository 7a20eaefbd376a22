"""Outlines of regions and their overlap within a tolerance (boundary measure of Perazzi et al. 2016, Xie et al.)."""

from __future__ import annotations

import math

import numpy as np

from objectflow.typing import Int64Array, LabelImage

TOLERANCE = 0.003
"""Dilation of outlines relative to the image's diagonal; rounded up to whole pixels."""


def tolerance_pixels(height: int, width: int) -> int:
    """`ceil(0.003 x diagonal)`: 2 at 320x240, 3 at 640x480."""
    return math.ceil(TOLERANCE * math.hypot(height, width))


def outlines(labels: LabelImage) -> dict[int, Int64Array]:
    """The outline of every object: label -> (N, 2) pixels as (row, column).

    A pixel is on a mask's outline if the mask changes between it and its right, lower or lower right neighbour, so an
    outline has pixels on both sides. The image's border is not an outline, since the mask may continue beyond it.
    """
    padded = np.pad(labels, ((0, 1), (0, 1)), mode="edge")
    corners = (padded[:-1, :-1], padded[:-1, 1:], padded[1:, :-1], padded[1:, 1:])
    rows, columns = np.nonzero((corners[1] != labels) | (corners[2] != labels) | (corners[3] != labels))
    # A mask changes at those of these pixels that have its label at one of the four corners.
    values = np.stack([corner[rows, columns] for corner in corners])
    pixels = np.stack([rows, columns], axis=1)
    return {int(label): pixels[(values == label).any(0)] for label in np.unique(values) if label != 0}


def count_near(pixels: Int64Array, others: Int64Array, radius: int, height: int, width: int) -> int:
    """The number of `pixels` (N, 2) within a Euclidean `radius` of `others` (M, 2), in an image of that size."""
    reach = np.arange(-radius, radius + 1)
    dy, dx = np.meshgrid(reach, reach, indexing="ij")
    disk = dy**2 + dx**2 <= radius**2
    stride = width + 2 * radius
    near = np.zeros((height + 2 * radius) * stride, np.bool_)
    near[(_flat(others, radius, stride)[:, None] + (dy[disk] * stride + dx[disk])).ravel()] = True
    return int(np.count_nonzero(near[_flat(pixels, radius, stride)]))


def _flat(pixels: Int64Array, radius: int, stride: int) -> Int64Array:
    return np.asarray((pixels[:, 0] + radius) * stride + pixels[:, 1] + radius)
