"""`RgbdFrame`: a colour image with registered depth, checked when it is created."""

from __future__ import annotations

from dataclasses import InitVar, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from objectflow.errors import CameraError, FrameError
from objectflow.geometry.camera import Camera, check_depth_scale, is_number
from objectflow.geometry.resample import resize_color, resize_nearest
from objectflow.storage.image_files import read_color, read_depth, to_metres
from objectflow.typing import BoolMask, Float32Array, UInt8Array

MAX_MEDIAN_DEPTH = 50.0
"""Metres. A larger median depth indicates a wrong depth scale."""

MIN_MEDIAN_DEPTH = 0.005
"""Metres. A smaller median depth indicates a wrong depth scale."""


@dataclass(frozen=True, eq=False)
class RgbdFrame:
    """One colour image with its registered depth.

    Images may be given as NumPy arrays, torch tensors on any device, or nested lists. Depth may also be (H, W, 1), and
    may be integers if `depth_scale` is given.

    Attributes:
        color: (H, W, 3) uint8, RGB.
        depth: (H, W) float32, planar z in metres, 0 where missing.
        camera: the pinhole camera of both images.
        timestamp: seconds; None where the source has none.
        name: origin of the frame, for messages.

    Args:
        depth_scale: units per metre of the given depth; None for metres.

    Raises:
        FrameError: wrong shapes or types; different sizes of colour, depth and camera; or depth that is missing
            everywhere, negative, not finite, or in millimetres.
    """

    color: UInt8Array
    depth: Float32Array
    camera: Camera
    timestamp: float | None = None
    name: str = field(default="frame")
    depth_scale: InitVar[float | None] = None

    def __post_init__(self, depth_scale: float | None) -> None:
        where = self.name
        if not isinstance(where, str):
            raise FrameError(f"the name of a frame must be text, not {where!r}")
        if self.timestamp is not None and not is_number(self.timestamp):
            raise FrameError(f"{where}: the timestamp must be a number of seconds or None, not {self.timestamp!r}")
        color, depth = (_as_array(value) for value in (self.color, self.depth))
        if isinstance(depth, np.ndarray) and depth.ndim == 3 and depth.shape[2] == 1:
            depth = depth[..., 0]
        if not isinstance(self.camera, Camera):
            raise FrameError(f"{where}: camera must be an objectflow.Camera, not {type(self.camera).__name__}")
        if not isinstance(color, np.ndarray) or color.ndim != 3 or color.shape[2] != 3:
            raise FrameError(f"{where}: colour must be an (H, W, 3) array, not {_describe(color)}")
        if color.dtype != np.uint8:
            raise FrameError(f"{where}: colour must be uint8 in 0..255, not {color.dtype}")
        if not isinstance(depth, np.ndarray) or depth.ndim != 2:
            raise FrameError(f"{where}: depth must be an (H, W) array, not {_describe(depth)}")
        if depth_scale is not None:
            check_depth_scale(depth_scale, where=f"{where}: ")
            if not np.issubdtype(depth.dtype, np.number):
                raise FrameError(f"{where}: depth must be numbers, not {depth.dtype}")
            with np.errstate(all="ignore"):  # an absurd scale gives 0 or infinity, which is reported below
                depth = depth.astype(np.float32) / np.float32(depth_scale)
        if not np.issubdtype(depth.dtype, np.floating):
            raise FrameError(
                f"{where}: depth must be float32 metres, not {depth.dtype}: give depth_scale, the units per metre"
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
        # Checked after the cast: a finite double may become infinite or 0 as float32.
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
        float_depth_scale: float = 1.0,
        max_depth: float | None = None,
        timestamp: float | None = None,
    ) -> RgbdFrame:
        """Read a colour and a depth image of any format of `objectflow.storage.image_files`.

        Args:
            color: an image of 8 or 16 bits per channel.
            depth: an image of integers, or of floating-point numbers.
            camera: the camera of both images.
            depth_scale: units per metre of integer depth.
            float_depth_scale: units per metre of floating-point depth.
            max_depth: depth beyond it is missing, metres.
            timestamp: seconds; None where there is none.

        Raises:
            ReaderError: a file is missing, broken or of the wrong kind.
            FrameError: the images do not form a valid frame.
        """
        for scale in (depth_scale, float_depth_scale):
            check_depth_scale(scale)
        color_image, depth_image = read_color(Path(color)), read_depth(Path(depth))
        metres = to_metres(
            depth_image, depth_scale=depth_scale, float_depth_scale=float_depth_scale, max_depth=max_depth
        )
        return cls(color=color_image, depth=metres, camera=camera, timestamp=timestamp, name=str(depth))

    @property
    def valid(self) -> BoolMask:
        """(H, W) bool: pixels with depth."""
        return self.depth > 0

    def __repr__(self) -> str:
        share = 100 * float(self.valid.mean())
        depth = f"{np.median(self.depth[self.valid]):.2f} m" if share else "no depth"
        when = "" if self.timestamp is None else f", t={self.timestamp:.3f}"
        size = f"{self.camera.width}x{self.camera.height}"
        return f"RgbdFrame({self.name!r}, {size}, depth at {share:.0f}% of pixels, median {depth}{when})"

    def resized(self, width: int, height: int) -> RgbdFrame:
        """The frame at another resolution: colour by area, depth by nearest neighbour, which keeps its edges sharp.

        Raises:
            CameraError: a size that is not whole and positive.
            FrameError: no pixel with depth is left.
        """
        camera = self.camera.scaled(width, height)
        width, height = camera.width, camera.height
        if (width, height) == (self.camera.width, self.camera.height):
            return self
        return RgbdFrame(
            color=resize_color(self.color, (height, width)),
            depth=resize_nearest(self.depth, (height, width)),
            camera=camera,
            timestamp=self.timestamp,
            name=self.name,
        )

    def cropped(self, x: int, y: int, width: int, height: int) -> RgbdFrame:
        """The part of the frame whose top-left pixel is (x, y).

        Raises:
            CameraError: the crop leaves the image.
            FrameError: no pixel of the crop has depth.
        """
        camera = self.camera.cropped(x, y, width, height)
        part = slice(y, y + height), slice(x, x + width)
        return RgbdFrame(self.color[part], self.depth[part], camera, self.timestamp, self.name)

    def downscaled_to_width(self, width: int) -> RgbdFrame:
        """The frame at a width in pixels, with its aspect ratio kept; unchanged if it is no wider.

        Raises:
            CameraError: a width that is not whole and positive.
        """
        if not is_number(width) or not width >= 1:
            raise CameraError(f"a width must be a whole and positive number of pixels, not {width!r}")
        if self.camera.width <= width:
            return self
        whole = int(width)
        return self.resized(whole, max(1, round(self.camera.height * whole / self.camera.width)))


def _as_array(value: Any) -> Any:
    """Convert an array, tensor or nested list to an array; other values are returned for the error message."""
    if isinstance(value, np.ndarray):
        return value
    if hasattr(value, "detach") and hasattr(value, "cpu"):  # a torch tensor, without importing torch
        return np.asarray(value.detach().cpu())
    if isinstance(value, list | tuple):
        try:
            found = np.asarray(value)
        except (TypeError, ValueError, OverflowError):
            return value
        # Lists of whole numbers become int64; colour is uint8.
        is_bytes = (
            found.dtype.kind == "i" and found.ndim == 3 and found.size and 0 <= found.min() <= found.max() <= 255
        )
        return found.astype(np.uint8) if is_bytes and found.shape[2] == 3 else found
    return value


def check_pair(prev: RgbdFrame, curr: RgbdFrame) -> None:
    """Check that two frames have the same size and the same camera.

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
            f"{where}: the median depth is {median:.0f} m: is it in millimetres? "
            "Check the depth scale (units per metre)"
        )
    if median < MIN_MEDIAN_DEPTH:
        raise FrameError(
            f"{where}: the median depth is {median * 1000:.2g} mm: check the depth scale (units per metre)"
        )


def _describe(value: object) -> str:
    return f"an array of shape {value.shape}" if isinstance(value, np.ndarray) else type(value).__name__
