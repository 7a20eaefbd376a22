"""Surface normals of depth images."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from objectflow import geometry
from objectflow.geometry.camera import Camera
from objectflow.typing import Float32Array

_MAX_STEP = 0.04
"""Largest difference of depth within a window, relative to depth: 75 degrees of tilt for a typical lens."""
_STEP_MARGIN = 0.01
"""Metres, added to `_MAX_STEP` for noise."""


def surface_normals(depth: NDArray[Any], camera: Camera) -> Float32Array:
    """(H, W) depth -> (H, W, 3) unit normals toward the camera; NaN at holes and depth edges.

    A linear function is fitted to the inverse depth of each fully valid 5x5 window by box sums, since the inverse
    depth of a plane is linear in pixel coordinates.
    """
    valid = depth > 0
    inverse = np.where(valid, 1 / np.maximum(depth, 1e-6), 0).astype(np.float32, copy=False)
    size, window = (5, 5), np.ones((5, 5), np.uint8)
    near = cv2.erode(np.where(valid, depth, np.inf).astype(np.float32, copy=False), window)
    far = cv2.dilate(depth, window)
    # A tilted surface also changes depth over five pixels.
    smooth = (far - near < _MAX_STEP * depth + _STEP_MARGIN) & (cv2.erode(valid.view(np.uint8), window) > 0)
    kernel = np.arange(-2, 3, dtype=np.float32)
    ones = np.ones(5, np.float32)
    slope_u = cv2.sepFilter2D(inverse, -1, kernel / 50, ones)
    slope_v = cv2.sepFilter2D(inverse, -1, ones, kernel / 50)
    x, y = geometry.pixel_rays(camera)
    # 1/z = a x + b y + c on rays (x, y, 1) describes the plane with normal (a, b, c).
    a, b = slope_u * camera.fx, slope_v * camera.fy
    c = cv2.boxFilter(inverse, -1, size) - a * x - b * y[:, None]
    length = np.sqrt(a * a + b * b + c * c) + 1e-12
    smooth[:2] = smooth[-2:] = smooth[:, :2] = smooth[:, -2:] = False  # the window exceeds the image here
    return np.asarray(cv2.merge([np.where(smooth, -one / length, np.float32(np.nan)) for one in (a, b, c)]))
