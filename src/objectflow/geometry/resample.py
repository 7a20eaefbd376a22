"""Images at other sizes and at fractional pixels."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from objectflow.frame import RgbdFrame

Mask = NDArray[np.bool_]


def enlarge(mask: Mask, frame: RgbdFrame) -> Mask:
    """A mask brought to a frame's size by its nearest pixels."""
    size = (frame.camera.width, frame.camera.height)
    return np.asarray(cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0)


def nearest(source: tuple[int, ...], size: tuple[int, ...]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """The row and the column of `source` (h, w) whose centre is nearest to that of each of `size` (H, W)."""
    (h, w), (height, width) = source, size
    rows = np.minimum(((np.arange(height) + 0.5) * h / height).astype(np.intp), h - 1)
    columns = np.minimum(((np.arange(width) + 0.5) * w / width).astype(np.intp), w - 1)
    return rows, columns
