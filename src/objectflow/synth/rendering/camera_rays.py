"""The rays of a MuJoCo camera's pixels."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from objectflow.geometry.camera import Camera
from objectflow.typing import Float32Array

_RADIUS = 0.471
"""Pixels from a pixel's centre to the other three of four samples: they scatter as a whole pixel's area does (their
mean square along x and y is 1/12)."""
_FIRST_TURN = math.radians(15)
"""Turns the triangle so that no two samples share a column or a row."""


def camera_of(model: Any, width: int, height: int) -> Camera:
    """The pinhole camera named `camera` of a `mujoco.MjModel`, at a resolution of its own shape."""
    number = model.camera("camera").id
    sensor = np.asarray(model.cam_sensorsize[number], dtype=np.float64)
    intrinsic = np.asarray(model.cam_intrinsic[number], dtype=np.float64)
    if sensor[1] > 0:
        focal = intrinsic[:2] / sensor * (width, height)
        # MuJoCo counts from the image's middle, and the other way round.
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
    """(samples * height * width, 3) unit directions in MuJoCo's camera frame (x right, y up, z backward).

    The first height * width go through the pixels' centres, row by row; every further sample follows as a whole image.
    """
    camera = camera_of(model, width, height)
    turns = _FIRST_TURN + np.arange(samples - 1) * (2 * math.pi / 3)
    offsets = np.concatenate([np.zeros((1, 2)), _RADIUS * np.stack([np.cos(turns), np.sin(turns)], axis=1)])
    column, row = np.meshgrid(np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64))
    x = (column + offsets[:, 0, None, None] - camera.cx) / camera.fx
    y = (row + offsets[:, 1, None, None] - camera.cy) / camera.fy
    rays = np.stack([x, -y, -np.ones_like(x)], axis=-1)
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    return rays.reshape(-1, 3).astype(np.float32)
