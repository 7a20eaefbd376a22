"""A quick guess of how far the image moved between two frames: the median normal flow of its edges."""

from __future__ import annotations

import cv2
import numpy as np

from objectflow.alignment.prepared_frame import PreparedFrame
from objectflow.geometry.resample import resize_nearest
from objectflow.typing import BoolMask

WIDTH = 320
"""Pixels: width at which the images are compared."""
_BLUR = 1.5
"""Pixels: standard deviation of the blur, which makes differences linear in the shift."""
_STRIDE = 2
"""Pixels between those that are compared."""
_EDGES = 0.8
"""Quantile of the gradient's magnitude from which a pixel is an edge."""
_NOISE = 2.0
"""Grey levels: gradients below this per pixel show no shift."""


def apparent_shift(prev: PreparedFrame, curr: PreparedFrame, ignored: BoolMask | None = None) -> float:
    """The median shift of edges along their gradient, in pixels at `WIDTH`; 0 for images without edges.

    Where the whole image shifts by up to two pixels, this is about 0.7 of the shift, since edges have all directions.
    A change of light looks like a shift.

    Args:
        prev, curr: the frames.
        ignored: (H, W) bool of any size, pixels of the current frame that may move by themselves; None for none.
    """
    before, after = (
        cv2.GaussianBlur(frame.at_width(WIDTH).gray.astype(np.float32), (0, 0), _BLUR) for frame in (prev, curr)
    )
    along, down = (cv2.Sobel(after, cv2.CV_32F, *axis, scale=1 / 8) for axis in ((1, 0), (0, 1)))
    gradient = cv2.magnitude(along, down)[::_STRIDE, ::_STRIDE]
    difference = np.abs(after - before)[::_STRIDE, ::_STRIDE]
    edges = gradient > max(_NOISE, float(np.quantile(gradient, _EDGES)))
    if ignored is not None:
        edges &= ~resize_nearest(ignored, after.shape)[::_STRIDE, ::_STRIDE]
    return float(np.median(difference[edges] / gradient[edges])) if edges.any() else 0.0
