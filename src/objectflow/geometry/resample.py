"""Images at other sizes and at fractional pixels."""

from __future__ import annotations

import cv2
import numpy as np

from objectflow.frame import RgbdFrame
from objectflow.typing import BoolMask, IndexArray


def upsample_mask(mask: BoolMask, frame: RgbdFrame) -> BoolMask:
    """A mask brought to a frame's size by its nearest pixels."""
    size = (frame.camera.width, frame.camera.height)
    return np.asarray(cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0)


def nearest_indices(source: tuple[int, ...], size: tuple[int, ...]) -> tuple[IndexArray, IndexArray]:
    """The row and the column of `source` (h, w) whose centre is nearest to that of each of `size` (H, W)."""
    (h, w), (height, width) = source, size
    rows = np.minimum(((np.arange(height) + 0.5) * h / height).astype(np.intp), h - 1)
    columns = np.minimum(((np.arange(width) + 0.5) * w / width).astype(np.intp), w - 1)
    return rows, columns
