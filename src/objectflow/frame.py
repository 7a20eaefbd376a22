"""`Camera` and `RgbdFrame`: what comes in, checked at the door."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from objectflow.errors import FrameError
from objectflow.geometry.camera import Camera, check_depth_scale
from objectflow.storage.images import read_color, read_depth
from objectflow.typing import BoolMask, Float32Array, UInt8Array

MAX_MEDIAN_DEPTH = 50.0
"""Metres. No depth camera sees further than this in half of its pixels; a wrong scale does."""

MIN_MEDIAN_DEPTH = 0.005
"""Metres. Nearer than any depth camera can focus."""


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

    color: UInt8Array
    depth: Float32Array
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
    def valid(self) -> BoolMask:
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

    def downscaled_to_width(self, width: int) -> RgbdFrame:
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
