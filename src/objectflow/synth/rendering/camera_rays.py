"""Pixel rays of a MuJoCo camera."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from objectflow.geometry.camera import Camera
from objectflow.typing import Float32Array

_SAMPLE_RADIUS = 0.471
"""Distance from a pixel's centre to the other three of four samples, pixels. The four have the variance of a uniformly
sampled pixel, 1/12 along x and y."""
_SAMPLE_ANGLE = math.radians(15)
"""Orientation of the three samples, radians: no two samples have the same column or row."""


def camera_of(model: Any, width: int, height: int) -> Camera:
    """Intrinsics of the camera named `camera` of a `mujoco.MjModel` at a resolution with its aspect ratio."""
    number = model.camera("camera").id
    sensor = np.asarray(model.cam_sensorsize[number], dtype=np.float64)
    intrinsic = np.asarray(model.cam_intrinsic[number], dtype=np.float64)
    if sensor[1] > 0:
        focal = intrinsic[:2] / sensor * (width, height)
        # MuJoCo's principal point is relative to the image centre and has the opposite sign.
        offset = intrinsic[2:] / sensor * (width, height)
    else:
        focal = np.full(2, height / 2 / math.tan(math.radians(float(model.cam_fovy[number])) / 2))
        offset = np.zeros(2)
    return Camera(
        width=width,
        height=height,
        fx=float(focal[0]),
        fy=float(focal[1]),
        cx=float((width - 1) / 2 - offset[0]),
        cy=float((height - 1) / 2 - offset[1]),
    )


def pixel_rays(model: Any, width: int, height: int, samples: int) -> Float32Array:
    """(samples * height * width, 3) unit ray directions in MuJoCo's camera frame (x right, y up, z backward).

    The first height * width rays go through the pixel centres in row-major order; the further samples follow, each for
    the whole image.
    """
    camera = camera_of(model, width, height)
    angles = _SAMPLE_ANGLE + np.arange(samples - 1) * (2 * math.pi / 3)
    offsets = np.concatenate([np.zeros((1, 2)), _SAMPLE_RADIUS * np.stack([np.cos(angles), np.sin(angles)], axis=1)])
    column, row = np.meshgrid(np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64))
    x = (column + offsets[:, 0, None, None] - camera.cx) / camera.fx
    y = (row + offsets[:, 1, None, None] - camera.cy) / camera.fy
    rays = np.stack([x, -y, -np.ones_like(x)], axis=-1)
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    return rays.reshape(-1, 3).astype(np.float32)
