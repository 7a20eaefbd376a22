"""The intrinsics that a camera file holds, before they are joined with the size of the images."""

from __future__ import annotations

import math
import reprlib
from dataclasses import dataclass
from typing import Any

import numpy as np

from objectflow.errors import CameraError
from objectflow.geometry.camera import Camera
from objectflow.readers.lens import Lens, make_lens
from objectflow.typing import Float64Array


@dataclass(frozen=True)
class CameraValues:
    """Intrinsics of a camera file.

    Attributes:
        fx, fy, cx, cy: in pixels; the centre of the top-left pixel is (0, 0).
        size: (width, height) of the image; None where the file has no size.
        depth_scale: units per metre of integer depth; None where the file has none.
        distortion_model: name of the distortion model, as in ROS; empty without distortion.
        distortion: coefficients in the order of the model; empty without distortion.
        note: an interpretation that the caller should know; empty where there is none.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    size: tuple[int, int] | None = None
    depth_scale: float | None = None
    distortion_model: str = ""
    distortion: tuple[float, ...] = ()
    note: str = ""

    def camera(self, size: tuple[int, int], where: str) -> Camera:
        """The camera of images of a size (width, height).

        Raises:
            CameraError: invalid intrinsics; the message starts with `where`.
        """
        check_upright(self.fx, self.fy, self.cx, self.cy, where)
        width, height = self.size or size
        try:
            return Camera(width=width, height=height, fx=self.fx, fy=self.fy, cx=self.cx, cy=self.cy)
        except CameraError as error:
            raise CameraError(f"{where}: {error}") from error

    def lens(self, where: str) -> Lens | None:
        """The distortion; None for a pinhole.

        Raises:
            CameraError: an unknown model; the message starts with `where`.
        """
        try:
            # The names of librealsense have the prefix "distortion.".
            return make_lens(self.distortion_model.rpartition(".")[2], self.distortion)
        except CameraError as error:
            raise CameraError(f"{where}: {error}") from error


def check_upright(fx: float, fy: float, cx: float, cy: float, where: str) -> None:
    """Refuse negative focal lengths with the remedy.

    ICL-NUIM states fy = -480 because the y axis of its world points up. Its images are stored upright, so that the
    same images have a positive fy in a camera frame whose y axis points down.

    Raises:
        CameraError: a negative focal length.
    """
    if fx < 0 or fy < 0:
        raise CameraError(
            f"{where}: negative focal length fx={fx:g}, fy={fy:g} (ICL-NUIM): images that are stored upright have a "
            f"positive one: give --intrinsics {abs(fx):g} {abs(fy):g} {cx:g} {cy:g}"
        )


def from_matrix(values: Any, where: str) -> tuple[float, float, float, float]:
    """The fx, fy, cx, cy of an intrinsic matrix.

    Args:
        values: 9, 12 or 16 numbers, or a 3x3, 3x4 or 4x4 matrix, in row-major order; 9 numbers may also be in
            column-major order, as Open3D writes them.
        where: start of messages.

    Raises:
        CameraError: not such a matrix, or one with skew.
    """
    try:
        matrix = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise CameraError(f"{where}: an intrinsic matrix holds numbers: {error}") from error
    shapes: dict[int, tuple[int, int]] = {9: (3, 3), 12: (3, 4), 16: (4, 4)}
    if matrix.size not in shapes or matrix.ndim > 2 or not np.isfinite(matrix).all():
        raise CameraError(f"{where}: an intrinsic matrix holds 3x3 finite numbers, not an array of {matrix.shape}")
    matrix = matrix.reshape(shapes[matrix.size])[:3, :3]
    if _is_intrinsic(matrix.T) and not _is_intrinsic(matrix):
        matrix = matrix.T
    if not _is_intrinsic(matrix):
        raise CameraError(f"{where}: K must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], without skew")
    return float(matrix[0, 0]), float(matrix[1, 1]), float(matrix[0, 2]), float(matrix[1, 2])


def number(value: Any, name: str, where: str) -> float:
    """A finite number of a camera file.

    Raises:
        CameraError: anything else.
    """
    try:
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
            raise CameraError(f"{where}: camera {name} must be a finite number, not {reprlib.repr(value)}")
        return float(value)
    except OverflowError:
        raise CameraError(f"{where}: camera {name} is too large a number") from None


def _is_intrinsic(matrix: Float64Array) -> bool:
    # Skew of a fraction of a pixel is a rounding error of a calibration.
    zero = np.abs(matrix[[0, 1, 2, 2], [1, 0, 0, 1]])
    return bool(zero.max() < 1e-3 and abs(matrix[2, 2] - 1) < 1e-6)
