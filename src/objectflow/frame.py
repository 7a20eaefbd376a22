"""`Camera` and `RgbdFrame`: what comes in, checked at the door."""

from __future__ import annotations

import json
import math
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from objectflow.errors import CameraError, FrameError, ReaderError

MAX_MEDIAN_DEPTH = 50.0
"""Metres. No depth camera sees further than this in half of its pixels; a wrong scale does."""

MIN_MEDIAN_DEPTH = 0.005
"""Metres. Nearer than any depth camera can focus."""


@dataclass(frozen=True)
class Camera:
    """A pinhole camera without distortion; x right, y down, z forward, the first pixel's centre at (0, 0).

    Attributes:
        width, height: image size in pixels.
        fx, fy: focal lengths in pixels.
        cx, cy: principal point in pixels.

    Raises:
        CameraError: a value that is not finite or positive, or a principal point outside the image.
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
            if isinstance(value, bool) or not isinstance(value, (int, float, np.integer, np.floating)):
                raise CameraError(f"camera {name} must be a number, not {value!r}")
            if not _is_finite(value):
                raise CameraError(f"camera {name} must be a finite number of common size")
        if int(self.width) != self.width or int(self.height) != self.height or min(self.width, self.height) < 1:
            raise CameraError(f"camera size must be whole and positive, not {self.width}x{self.height}")
        if self.fx <= 0 or self.fy <= 0:
            raise CameraError(f"focal lengths must be positive, not fx={self.fx:g}, fy={self.fy:g}")
        if not (-0.5 <= self.cx <= self.width - 0.5 and -0.5 <= self.cy <= self.height - 0.5):
            raise CameraError(
                f"the principal point ({self.cx:g}, {self.cy:g}) lies outside the {self.width}x{self.height} image: "
                "are these the intrinsics of another resolution?"
            )
        if not 0.1 <= self.fx / self.width <= 20 or not 0.1 <= self.fy / self.height <= 20:
            raise CameraError(
                f"fx={self.fx:g}, fy={self.fy:g} do not fit a {self.width}x{self.height} image: "
                "are they in pixels, and of this resolution?"
            )
        for name, kind in (("width", int), ("height", int), ("fx", float), ("fy", float), ("cx", float)):
            object.__setattr__(self, name, kind(getattr(self, name)))
        object.__setattr__(self, "cy", float(self.cy))

    @property
    def matrix(self) -> NDArray[np.float64]:
        """The 3x3 intrinsic matrix K, in pixels."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]], dtype=np.float64)

    def scaled(self, width: int, height: int) -> Camera:
        """The same camera at another resolution. Pixel centres are whole, so the corner is at (-0.5, -0.5)."""
        sx, sy = width / self.width, height / self.height
        return Camera(
            width=width,
            height=height,
            fx=self.fx * sx,
            fy=self.fy * sy,
            # Multiply first: a quotient rounded up would carry a principal point on the border out of the image.
            cx=(self.cx + 0.5) * width / self.width - 0.5,
            cy=(self.cy + 0.5) * height / self.height - 0.5,
        )

    def cropped(self, x: int, y: int, width: int, height: int) -> Camera:
        """The camera of the image part whose first pixel is (x, y).

        Raises:
            CameraError: the part does not lie within the image or misses the principal point.
        """
        if x < 0 or y < 0 or x + width > self.width or y + height > self.height:
            raise CameraError(f"crop {width}x{height}+{x}+{y} leaves the {self.width}x{self.height} image")
        return Camera(width=width, height=height, fx=self.fx, fy=self.fy, cx=self.cx - x, cy=self.cy - y)

    def to_dict(self) -> dict[str, float]:
        """`{"width", "height", "fx", "fy", "cx", "cy"}`, as in `camera.json`."""
        return {name: getattr(self, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}

    @classmethod
    def from_dict(cls, values: Mapping[str, Any], *, where: str = "camera") -> Camera:
        """Make a camera of a mapping with the six names; further names are left alone.

        Raises:
            CameraError: a name is missing or its value is no number; the message starts with `where`.
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
        """Read `camera.json`: the camera, and `depth_scale` (depth units a metre) where the file has one.

        Raises:
            ReaderError: no such file, or not JSON.
            CameraError: values that are missing or make no camera.
            FrameError: a depth scale that is no positive number.
        """
        path = Path(path)
        try:
            values = json.loads(path.read_text(encoding="utf-8"))
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


@dataclass(frozen=True, eq=False)
class RgbdFrame:
    """One colour image with its registered depth.

    Attributes:
        color: (H, W, 3) uint8, RGB.
        depth: (H, W) float32, planar z in metres, 0 where missing.
        camera: the pinhole camera of both images.
        timestamp: seconds, where the source has one.
        name: where the frame came from, for messages.

    Raises:
        FrameError: wrong shapes or types, sizes that differ, depth that is missing everywhere, negative, not
            finite, or in millimetres; a camera of another size.
    """

    color: NDArray[np.uint8]
    depth: NDArray[np.float32]
    camera: Camera
    timestamp: float | None = None
    name: str = field(default="frame")

    def __post_init__(self) -> None:
        color, depth, where = self.color, self.depth, self.name
        if not isinstance(self.camera, Camera):
            raise FrameError(f"{where}: camera must be an objectflow.Camera, not {type(self.camera).__name__}")
        if not isinstance(color, np.ndarray) or color.ndim != 3 or color.shape[2] != 3:
            raise FrameError(f"{where}: colour must be an (H, W, 3) array, not {_describe(color)}")
        if color.dtype != np.uint8:
            raise FrameError(f"{where}: colour must be uint8 in 0..255, not {color.dtype}")
        if not isinstance(depth, np.ndarray) or depth.ndim != 2:
            raise FrameError(f"{where}: depth must be an (H, W) array, not {_describe(depth)}")
        if not np.issubdtype(depth.dtype, np.floating):
            raise FrameError(
                f"{where}: depth must be float32 metres, not {depth.dtype}: divide it by the camera's units a metre"
            )
        if color.shape[:2] != depth.shape:
            raise FrameError(
                f"{where}: colour is {color.shape[1]}x{color.shape[0]}, depth {depth.shape[1]}x{depth.shape[0]}: "
                "register the depth to the colour image"
            )
        if color.shape[:2] != (self.camera.height, self.camera.width):
            raise FrameError(
                f"{where}: the images are {color.shape[1]}x{color.shape[0]}, "
                f"the camera is {self.camera.width}x{self.camera.height}"
            )
        with np.errstate(over="ignore", under="ignore"):
            metres = np.ascontiguousarray(depth, dtype=np.float32)
        # After the cast: a double may be finite, and its float32 infinite or 0.
        _check_depth_values(metres, where)
        object.__setattr__(self, "color", np.ascontiguousarray(color))
        object.__setattr__(self, "depth", metres)

    @classmethod
    def read(
        cls,
        color: str | Path,
        depth: str | Path,
        *,
        camera: Camera,
        depth_scale: float = 1000.0,
        timestamp: float | None = None,
    ) -> RgbdFrame:
        """Read a colour image (PNG, JPEG, ...) and a 16-bit depth PNG; metres = value / `depth_scale`.

        Raises:
            ReaderError: a file that is missing, broken or of the wrong kind.
            FrameError: images that make no frame.
        """
        check_depth_scale(depth_scale)
        color_image, depth_image = read_color(Path(color)), read_depth(Path(depth))
        with np.errstate(all="ignore"):  # an absurd scale gives 0 or infinity, which the frame reports
            metres = depth_image.astype(np.float32) / np.float32(depth_scale)
        return cls(color=color_image, depth=metres, camera=camera, timestamp=timestamp, name=str(depth))

    @property
    def valid(self) -> NDArray[np.bool_]:
        """(H, W) bool: where depth was measured."""
        return self.depth > 0

    def resized(self, width: int, height: int) -> RgbdFrame:
        """The frame at another resolution: colour by area, depth by nearest neighbour, so no edge is smeared.

        Raises:
            CameraError: a size that is not whole and positive.
            FrameError: none of the pixels that were measured is left.
        """
        camera = self.camera.scaled(width, height)
        if (width, height) == (self.camera.width, self.camera.height):
            return self
        shrink = width < self.camera.width
        color = cv2.resize(self.color, (width, height), interpolation=cv2.INTER_AREA if shrink else cv2.INTER_LINEAR)
        # cv2's own nearest neighbour takes the top-left pixel of a block, half a block off; these are the centres.
        rows = ((np.arange(height) + 0.5) * self.camera.height / height).astype(int)
        columns = ((np.arange(width) + 0.5) * self.camera.width / width).astype(int)
        return RgbdFrame(
            color=color.astype(np.uint8, copy=False),
            depth=self.depth[rows[:, None], columns[None, :]],
            camera=camera,
            timestamp=self.timestamp,
            name=self.name,
        )

    def narrowed(self, width: int) -> RgbdFrame:
        """The frame at `width` pixels and its own proportions; itself if it is no wider."""
        if self.camera.width <= width:
            return self
        return self.resized(width, max(1, round(self.camera.height * width / self.camera.width)))


def check_pair(prev: RgbdFrame, curr: RgbdFrame) -> None:
    """Check that two frames can be compared.

    Raises:
        FrameError: the frames differ in size or in intrinsics.
    """
    if prev.depth.shape != curr.depth.shape:
        raise FrameError(
            f"the previous frame is {prev.camera.width}x{prev.camera.height}, "
            f"the current one {curr.camera.width}x{curr.camera.height}: both must have one size"
        )
    if prev.camera != curr.camera:
        raise FrameError("the two frames have different intrinsics: both must come from one camera")


def check_depth_scale(scale: object, *, where: str = "") -> None:
    """Check that a depth scale (units a metre) is a finite positive number.

    Raises:
        FrameError: it is not; the message starts with `where`.
    """
    if isinstance(scale, bool) or not isinstance(scale, (int, float, np.integer, np.floating)):
        raise FrameError(f"{where}depth_scale must be a number of depth units a metre, not {scale!r}")
    if not _is_finite(scale) or scale <= 0:
        raise FrameError(f"{where}depth_scale must be a positive, finite number of depth units a metre")


def _is_finite(value: float | np.integer[Any] | np.floating[Any]) -> bool:
    """`math.isfinite`, which knows no integers beyond the range of floats."""
    try:
        return math.isfinite(value)
    except OverflowError:
        return False


def read_color(path: Path) -> NDArray[np.uint8]:
    """Read a colour image as (H, W, 3) uint8 RGB; grey is repeated, alpha dropped.

    Raises:
        ReaderError: the file is missing, broken, or looks like depth.
    """
    image = read_image(path)
    if image.dtype != np.uint8:
        raise ReaderError(
            f"{path}: a colour image has 8 bits a channel, this has {image.dtype.itemsize * 8}: "
            "are colour and depth swapped?"
        )
    if image.ndim == 2:
        image = np.repeat(image[..., None], 3, axis=2)
    return np.ascontiguousarray(image[..., 2::-1], dtype=np.uint8)


def read_depth(path: Path) -> NDArray[np.uint16]:
    """Read a depth image as (H, W) uint16, in the file's own units.

    Raises:
        ReaderError: the file is missing, broken, or is no 16-bit single-channel image.
    """
    image = read_image(path)
    if image.ndim != 2:
        raise ReaderError(
            f"{path}: a depth image has one channel, this has {image.shape[2]}: are colour and depth swapped?"
        )
    if image.dtype != np.uint16:
        raise ReaderError(
            f"{path}: a depth image has 16 bits a pixel, this has {image.dtype.itemsize * 8}: "
            "save raw depth, not a picture of it"
        )
    return np.asarray(image, dtype=np.uint16)


def read_image(path: Path) -> NDArray[Any]:
    """Read an image of any kind as OpenCV gives it: (H, W) or (H, W, 3 or 4), BGR.

    Raises:
        ReaderError: the file is missing, cut off or broken.
    """
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        raise ReaderError(f"{path}: no such file") from None
    except OSError as error:
        raise ReaderError(f"{path}: cannot be read: {error.strerror}") from error
    # Some versions of OpenCV fill the missing rows of a cut-off file and say nothing.
    if data.startswith(b"\x89PNG\r\n\x1a\n"):
        _check_png(data, path)
    if data.startswith(b"\xff\xd8") and data.rfind(b"\xff\xd9") < data.rfind(b"\xff\xda"):
        raise ReaderError(f"{path}: the JPEG is cut off: copy the file again")
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED) if data else None
    except cv2.error:
        image = None
    if image is None:
        raise ReaderError(f"{path}: not an image that can be decoded (PNG or JPEG expected)")
    if image.ndim == 3 and image.shape[2] not in (3, 4):
        raise ReaderError(f"{path}: an image with {image.shape[2]} channels is neither colour nor depth")
    return np.asarray(image)


def _check_png(data: bytes, path: Path) -> None:
    """Walk a PNG's chunks: OpenCV believes a damaged length and fills gigabytes before it finds out."""
    at = 8
    while at + 12 <= len(data):
        end = at + 12 + int.from_bytes(data[at : at + 4], "big")
        if end > len(data):
            break
        if zlib.crc32(data[at + 4 : end - 4]) != int.from_bytes(data[end - 4 : end], "big"):
            raise ReaderError(f"{path}: not an image that can be decoded: the PNG is damaged: copy the file again")
        if data[at + 4 : at + 8] == b"IEND":
            return
        at = end
    raise ReaderError(f"{path}: the PNG is cut off: copy the file again")


def _check_depth_values(depth: NDArray[np.floating[Any]], where: str) -> None:
    if not np.isfinite(depth).all():
        count = int((~np.isfinite(depth)).sum())
        raise FrameError(f"{where}: {count} depth values are NaN or infinite: mark missing depth with 0")
    if (depth < 0).any():
        raise FrameError(f"{where}: {int((depth < 0).sum())} depth values are negative: mark missing depth with 0")
    if not (depth > 0).any():
        raise FrameError(f"{where}: depth is missing everywhere (all zero)")
    median = float(np.median(depth[depth > 0]))
    if median > MAX_MEDIAN_DEPTH:
        raise FrameError(
            f"{where}: the median depth is {median:.0f} m: is it in millimetres? Check the depth scale (units a metre)"
        )
    if median < MIN_MEDIAN_DEPTH:
        raise FrameError(f"{where}: the median depth is {median * 1000:.2g} mm: check the depth scale (units a metre)")


def _describe(value: object) -> str:
    return f"an array of shape {value.shape}" if isinstance(value, np.ndarray) else type(value).__name__
