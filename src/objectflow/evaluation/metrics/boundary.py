"""Outlines of regions, and how much of one lies near another (boundary measure of Perazzi et al. 2016, Xie et al.)."""

from __future__ import annotations

import math

import numpy as np

from objectflow.typing import Int64Array, LabelImage

TOLERANCE = 0.003
"""Share of the image's diagonal by which outlines are dilated; rounded up to whole pixels."""


def tolerance_pixels(height: int, width: int) -> int:
    """`ceil(0.003 x diagonal)`: 2 at 320x240, 3 at 640x480."""
    return math.ceil(TOLERANCE * math.hypot(height, width))


def outlines(labels: LabelImage) -> dict[int, Int64Array]:
    """The outline of every object: label -> (N, 2) pixels as (row, column).

    A pixel is on a mask's outline where the mask changes between it and its right, lower or lower right neighbour,
    so an outline has pixels on both sides. The image's border is no outline: beyond it the mask may go on.
    """
    padded = np.pad(labels, ((0, 1), (0, 1)), mode="edge")
    corners = (padded[:-1, :-1], padded[:-1, 1:], padded[1:, :-1], padded[1:, 1:])
    rows, columns = np.nonzero((corners[1] != labels) | (corners[2] != labels) | (corners[3] != labels))
    # Among these pixels a mask changes at all that have its label at one of the four places.
    values = np.stack([corner[rows, columns] for corner in corners])
    pixels = np.stack([rows, columns], axis=1)
    return {int(label): pixels[(values == label).any(0)] for label in np.unique(values) if label != 0}


def count_near(pixels: Int64Array, others: Int64Array, radius: int, height: int, width: int) -> int:
    """How many of `pixels` (N, 2) lie within `radius` of one of `others` (M, 2), Euclidean; of an image's size."""
    reach = np.arange(-radius, radius + 1)
    dy, dx = np.meshgrid(reach, reach, indexing="ij")
    disk = dy**2 + dx**2 <= radius**2
    stride = width + 2 * radius
    near = np.zeros((height + 2 * radius) * stride, np.bool_)
    near[(_flat(others, radius, stride)[:, None] + (dy[disk] * stride + dx[disk])).ravel()] = True
    return int(np.count_nonzero(near[_flat(pixels, radius, stride)]))


def _flat(pixels: Int64Array, radius: int, stride: int) -> Int64Array:
    return np.asarray((pixels[:, 0] + radius) * stride + pixels[:, 1] + radius)
