"""Images at other sizes and at fractional pixels; pixel centres lie at whole numbers."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from objectflow.typing import BoolMask, IndexArray, UInt8Array


def nearest_indices(source: tuple[int, ...], size: tuple[int, ...]) -> tuple[IndexArray, IndexArray]:
    """Rows and columns of `source` (h, w) whose centres are nearest to those of the rows and columns of `size` (H, W).

    OpenCV's nearest neighbour takes the top-left pixel of a block instead, which is half a block off.
    """
    (h, w), (height, width) = source, size
    rows = np.minimum(((np.arange(height) + 0.5) * h / height).astype(np.intp), h - 1)
    columns = np.minimum(((np.arange(width) + 0.5) * w / width).astype(np.intp), w - 1)
    return rows, columns


def resize_nearest(image: NDArray[Any], size: tuple[int, ...]) -> NDArray[Any]:
    """Resize depth or labels (h, w) to `size` (H, W) by nearest neighbour: values are never mixed."""
    if image.shape == size:
        return image
    rows, columns = nearest_indices(image.shape, size)
    return np.asarray(image[rows[:, None], columns])


def resize_color(image: UInt8Array, size: tuple[int, ...]) -> UInt8Array:
    """Resize a colour image (h, w, 3) to `size` (H, W): averages over areas where it shrinks, bilinear otherwise."""
    height, width = size
    if image.shape[:2] == (height, width):
        return image
    mode = cv2.INTER_AREA if width < image.shape[1] else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(image, (width, height), interpolation=mode), dtype=np.uint8)


def upsample_mask(mask: BoolMask, size: tuple[int, ...]) -> BoolMask:
    """Resize a mask (h, w) to `size` (H, W) by OpenCV's nearest neighbour; exact for whole factors of enlargement."""
    height, width = size
    return np.asarray(cv2.resize(mask.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST) > 0)


def bilinear_corners(pixels: NDArray[Any], size: tuple[int, ...]) -> tuple[IndexArray, NDArray[Any]]:
    """The four pixels around each fractional pixel.

    Args:
        pixels: (N, 2) as (u, v), within 0..W-1 and 0..H-1.
        size: (H, W) of the image.

    Returns:
        (4, N) indices into the flattened image: top left, top right, bottom left, bottom right; and (2, N) positions
        between them along u and v, 0..1.
    """
    height, width = size
    low = np.minimum(np.floor(pixels), np.array([max(0, width - 2), max(0, height - 2)], pixels.dtype))
    first = low[:, 1].astype(np.intp) * width + low[:, 0].astype(np.intp)
    right, below = min(1, width - 1), width * min(1, height - 1)  # an image may be one pixel wide
    return first + np.array([[0], [right], [below], [below + right]]), (pixels - low).T


def interpolate_corners(corners: NDArray[Any], fraction: NDArray[Any]) -> NDArray[Any]:
    """Bilinear interpolation of values (4, N) or (4, N, C), ordered and placed as by `bilinear_corners`."""
    a, b, c, d = corners
    du, dv = fraction if corners.ndim == 2 else fraction[..., None]
    top, bottom = a + (b - a) * du, c + (d - c) * du
    return np.asarray(top + (bottom - top) * dv)


def sample_bilinear(image: NDArray[Any], pixels: NDArray[Any]) -> NDArray[Any]:
    """Sample an image bilinearly.

    Args:
        image: (H, W) or (H, W, C).
        pixels: (N, 2) as (u, v), within 0..W-1 and 0..H-1.

    Returns:
        (N,) or (N, C) in the dtype of `pixels`.
    """
    index, fraction = bilinear_corners(pixels, image.shape[:2])
    values = image.reshape(-1, *image.shape[2:])
    return interpolate_corners(values.take(index, axis=0).astype(pixels.dtype), fraction)
