"""Pinhole cameras: intrinsics, checked when they are created, and their JSON form."""

from __future__ import annotations

import json
import math
import reprlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeGuard

import numpy as np
from numpy.typing import ArrayLike

from objectflow.errors import CameraError, FrameError, ReaderError
from objectflow.typing import Float64Array

MAX_PIXELS = 64_000_000
"""Largest image of a camera, in pixels."""
MAX_IMAGE_BYTES = 8 * MAX_PIXELS
"""Largest image in memory, in bytes: colour of 4 channels has 16 bits each, and depth of one channel has 64 bits."""
MAX_FILE_BYTES = 1 << 24
"""Largest camera file, in bytes."""
MAX_DEPTH_SCALE = 1e9
"""Largest number of depth units per metre: nanometres."""
MAX_OFFSET = 20.0
"""Largest distance of the principal point from the origin, in image sizes."""

FOCAL_LENGTHS = (0.1, 20.0)
"""Smallest and largest focal length in image sizes: 157 and 3 degrees of view."""


@dataclass(frozen=True)
class Camera:
    """A pinhole camera without distortion; x right, y down, z forward, centre of the top-left pixel at (0, 0).

    Attributes:
        width, height: image size in pixels.
        fx, fy: focal lengths in pixels.
        cx, cy: principal point in pixels; it may lie outside the image, as in a crop.

    Raises:
        CameraError: a value that is not finite or positive, or that does not fit the image size.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float

    def __post_init__(self) -> None:
        for name in ("width", "height", "fx", "fy", "cx", "cy"):
            value = getattr(self, name)
            if not is_number(value):
                raise CameraError(f"camera {name} must be a number, not {reprlib.repr(value)}")
            if not _is_finite(value):
                raise CameraError(f"camera {name} must be a finite number of common size")
        if int(self.width) != self.width or int(self.height) != self.height or min(self.width, self.height) < 1:
            raise CameraError(f"camera size must be whole and positive, not {self.width}x{self.height}")
        if self.width * self.height > MAX_PIXELS:
            raise CameraError(f"a camera of {self.width}x{self.height} has more than {MAX_PIXELS // 10**6} megapixels")
        if self.fx <= 0 or self.fy <= 0:
            raise CameraError(f"focal lengths must be positive, not fx={self.fx:g}, fy={self.fy:g}")
        # A crop need not contain the principal point of its camera.
        if abs(self.cx) > MAX_OFFSET * self.width or abs(self.cy) > MAX_OFFSET * self.height:
            raise CameraError(
                f"the principal point ({self.cx:g}, {self.cy:g}) lies far outside the {self.width}x{self.height} "
                "image: are these the intrinsics of another resolution?"
            )
        low, high = FOCAL_LENGTHS
        if not low <= self.fx / self.width <= high or not low <= self.fy / self.height <= high:
            raise CameraError(
                f"fx={self.fx:g}, fy={self.fy:g} do not fit a {self.width}x{self.height} image: "
                "are they in pixels, and of this resolution?"
            )
        for name, kind in (("width", int), ("height", int), ("fx", float), ("fy", float), ("cx", float)):
            object.__setattr__(self, name, kind(getattr(self, name)))
        object.__setattr__(self, "cy", float(self.cy))

    @property
    def matrix(self) -> Float64Array:
        """The 3x3 intrinsic matrix K, in pixels."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]], dtype=np.float64)

    @classmethod
    def from_matrix(cls, K: ArrayLike, size: tuple[int, int]) -> Camera:
        """A camera from its intrinsic matrix.

        Args:
            K: (3, 3) in pixels; its skew must be 0.
            size: (width, height) of the image in pixels.

        Raises:
            CameraError: a matrix that is no such intrinsic matrix, or values that make no camera.
        """
        try:
            matrix = np.asarray(K, dtype=np.float64)
            width, height = size
        except (TypeError, ValueError) as error:
            raise CameraError(f"a camera needs a 3x3 matrix and (width, height): {error}") from error
        if matrix.shape != (3, 3) or not np.isfinite(matrix).all():
            raise CameraError(f"K must be a finite 3x3 matrix, not of shape {matrix.shape}")
        if np.any(matrix[[0, 1, 2, 2], [1, 0, 0, 1]] != 0) or matrix[2, 2] != 1:
            raise CameraError("K must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], without skew")
        (fx, _, cx), (_, fy, cy), _ = matrix.tolist()
        return cls(width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy)

    def __repr__(self) -> str:
        return f"Camera({self.width}x{self.height}, fx={self.fx:g}, fy={self.fy:g}, cx={self.cx:g}, cy={self.cy:g})"

    def scaled(self, width: int, height: int) -> Camera:
        """The same camera at another resolution. Pixel centres are whole numbers, so the corner is at (-0.5, -0.5).

        Raises:
            CameraError: a size that is not whole and positive.
        """
        for name, value in (("width", width), ("height", height)):
            if not is_number(value) or not 1 <= value <= MAX_PIXELS or int(value) != value:
                raise CameraError(
                    f"the {name} of an image must be a whole and positive number of pixels, not {reprlib.repr(value)}"
                )
        width, height = int(width), int(height)
        sx, sy = width / self.width, height / self.height
        return Camera(
            width=width,
            height=height,
            fx=self.fx * sx,
            fy=self.fy * sy,
            cx=(self.cx + 0.5) * width / self.width - 0.5,
            cy=(self.cy + 0.5) * height / self.height - 0.5,
        )

    def cropped(self, x: int, y: int, width: int, height: int) -> Camera:
        """The camera of the crop whose top-left pixel is (x, y).

        Raises:
            CameraError: the crop leaves the image.
        """
        if not all(map(is_number, (x, y, width, height))):
            raise CameraError(f"a crop needs four numbers of pixels, not {reprlib.repr((x, y, width, height))}")
        if not (x >= 0 and y >= 0 and width >= 1 and height >= 1):  # written so that NaN fails too
            raise CameraError(
                f"crop {width}x{height}+{x}+{y} must have a whole and positive size and start inside the "
                f"{self.width}x{self.height} image"
            )
        if x + width > self.width or y + height > self.height:
            raise CameraError(f"crop {width}x{height}+{x}+{y} leaves the {self.width}x{self.height} image")
        return Camera(width=width, height=height, fx=self.fx, fy=self.fy, cx=self.cx - x, cy=self.cy - y)

    def to_dict(self) -> dict[str, float]:
        """`{"width", "height", "fx", "fy", "cx", "cy"}`, as in `camera.json`."""
        return {name: getattr(self, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}

    @classmethod
    def from_dict(cls, values: Mapping[str, Any], *, where: str = "camera") -> Camera:
        """Create a camera from a mapping with the six names; other names are ignored.

        Raises:
            CameraError: a name is missing or its value is invalid; the message starts with `where`.
        """
        missing = [name for name in ("width", "height", "fx", "fy", "cx", "cy") if name not in values]
        if missing:
            raise CameraError(f"{where}: {', '.join(missing)} missing")
        try:
            return cls(**{name: values[name] for name in ("width", "height", "fx", "fy", "cx", "cy")})
        except CameraError as error:
            raise CameraError(f"{where}: {error}") from error

    @classmethod
    def read(cls, path: str | Path) -> tuple[Camera, float | None]:
        """Read `camera.json`: the camera, and `depth_scale` (depth units per metre) or None if the file lacks it.

        Raises:
            ReaderError: the file is missing or not JSON.
            CameraError: missing or invalid values.
            FrameError: a depth scale that is no positive number.
        """
        path = Path(path)
        try:
            # A pipe would wait for its writer, and a device has no end.
            if not path.is_file() and path.exists():
                raise ReaderError(f"{path}: a camera file must be a regular file")
            if path.stat().st_size > MAX_FILE_BYTES:
                raise ReaderError(f"{path}: too large for a camera file (at most {MAX_FILE_BYTES >> 20} MiB)")
            values = json.loads(path.read_bytes())
        except FileNotFoundError:
            raise ReaderError(f"{path}: no such camera file") from None
        except OSError as error:
            raise ReaderError(f"{path}: cannot be read: {error.strerror}") from error
        except (ValueError, RecursionError) as error:
            raise ReaderError(f"{path}: not a JSON file: {error}") from error
        if not isinstance(values, dict):
            raise ReaderError(f"{path}: expected a JSON object with width, height, fx, fy, cx, cy")
        scale = values.get("depth_scale")
        if scale is not None:
            check_depth_scale(scale, where=f"{path}: ")
        return cls.from_dict(values, where=str(path)), None if scale is None else float(scale)


def check_depth_scale(scale: object, *, where: str = "") -> None:
    """Check that a depth scale (units per metre) is a positive number of at most `MAX_DEPTH_SCALE`.

    Raises:
        FrameError: an invalid scale; the message starts with `where`.
    """
    if not is_number(scale):
        raise FrameError(f"{where}depth_scale must be a number of depth units per metre, not {reprlib.repr(scale)}")
    if not _is_finite(scale) or scale <= 0:
        raise FrameError(f"{where}depth_scale must be a positive, finite number of depth units per metre")
    if scale > MAX_DEPTH_SCALE:
        raise FrameError(
            f"{where}depth_scale must be at most {MAX_DEPTH_SCALE:g} depth units per metre, not {scale:g}"
        )


def is_number(value: object) -> TypeGuard[float]:
    """Whether a value is a real number of Python or NumPy; truth values, durations and strings are not."""
    if isinstance(value, (bool, np.timedelta64)):
        return False
    return isinstance(value, (int, float, np.integer, np.floating))


def _is_finite(value: float | np.integer[Any] | np.floating[Any]) -> bool:
    """`math.isfinite`, extended to integers beyond the range of floats."""
    try:
        return math.isfinite(value)
    except OverflowError:
        return False
