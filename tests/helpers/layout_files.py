"""Small recordings in the layouts of public data sets."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from objectflow.readers import CameraOptions

WIDTH, HEIGHT = 32, 24
CAMERA = {"width": WIDTH, "height": HEIGHT, "fx": 30.0, "fy": 31.0, "cx": 15.5, "cy": 11.5}
K = [30.0, 0, 15.5, 0, 31.0, 11.5, 0, 0, 1]
OPTIONS = CameraOptions(intrinsics=(30.0, 31.0, 15.5, 11.5))


def write(path: Path, image: NDArray[Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), image)


def color(value: int, width: int = WIDTH, height: int = HEIGHT) -> NDArray[np.uint8]:
    return np.full((height, width, 3), value, np.uint8)


def depth(value: int, width: int = WIDTH, height: int = HEIGHT) -> NDArray[np.uint16]:
    return np.full((height, width), value, np.uint16)


def write_frames(folder: Path, color_name: str, depth_name: str, count: int = 4, units: int = 1000) -> None:
    """Frame k has colour 10 + k and a depth of 1 + k / 10 metres."""
    for k in range(count):
        write(folder / color_name.format(k), color(10 + k))
        write(folder / depth_name.format(k), depth(round(units * (1 + k / 10))))


def check_frames(source: Any, count: int = 4) -> None:
    assert len(source) == count
    for k, frame in enumerate(source):
        assert frame.color[3, 4].tolist() == [10 + k] * 3
        np.testing.assert_allclose(frame.depth, 1 + k / 10, atol=1e-3)
