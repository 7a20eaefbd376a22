"""Removal of lens distortion: colour by linear interpolation, depth by the nearest pixel."""

from __future__ import annotations

from typing import Literal

import cv2
import numpy as np

from objectflow.errors import FrameError
from objectflow.geometry.camera import Camera
from objectflow.readers.lens import Lens
from objectflow.typing import Float32Array, UInt8Array


class Rectification:
    """Resamples images of a lens to those of a pinhole camera; pixels outside the image become black, without depth.

    Planar depth does not change: rectification moves pixels within the image plane.

    Args:
        lens: the distortion.
        source: intrinsics of the distorted images.
        target: the camera of the rectified images, with the same viewpoint; None for the intrinsics of `source`.
        images: which of the two images of a frame lie on the pixels of the lens.

    Attributes:
        source: intrinsics of the distorted images.
        target: the camera of the rectified images.
    """

    def __init__(
        self,
        lens: Lens,
        source: Camera,
        target: Camera | None = None,
        *,
        images: Literal["both", "color", "depth"] = "both",
    ) -> None:
        self.source = source
        self._images = images
        self.target = target or source
        u, v = np.meshgrid(np.arange(self.target.width), np.arange(self.target.height))
        x, y = (u.ravel() - self.target.cx) / self.target.fx, (v.ravel() - self.target.cy) / self.target.fy
        radius = np.hypot(x, y)
        seen = radius <= lens.largest_radius(float(radius.max()))
        distorted = lens.distort(np.column_stack([x, y])) * (source.fx, source.fy) + (source.cx, source.cy)
        distorted[~seen] = -2  # outside the image
        size = self.target.height, self.target.width
        self._map_u = np.ascontiguousarray(distorted[:, 0].reshape(size), dtype=np.float32)
        self._map_v = np.ascontiguousarray(distorted[:, 1].reshape(size), dtype=np.float32)

    def __call__(self, color: UInt8Array, depth: Float32Array) -> tuple[UInt8Array, Float32Array]:
        """Rectify the images of a frame."""
        return (
            self.color(color) if self._images != "depth" else color,
            self.depth(depth) if self._images != "color" else depth,
        )

    def color(self, image: UInt8Array) -> UInt8Array:
        """Rectify a colour image (H, W, 3) by linear interpolation."""
        self._check(image.shape, "colour")
        return np.asarray(cv2.remap(image, self._map_u, self._map_v, cv2.INTER_LINEAR), dtype=np.uint8)

    def depth(self, depth: Float32Array) -> Float32Array:
        """Rectify depth (H, W) by the nearest pixel."""
        self._check(depth.shape, "depth")
        return np.asarray(cv2.remap(depth, self._map_u, self._map_v, cv2.INTER_NEAREST), dtype=np.float32)

    def _check(self, shape: tuple[int, ...], name: str) -> None:
        if shape[:2] != (self.source.height, self.source.width):
            raise FrameError(
                f"{name} is {shape[1]}x{shape[0]}, its camera is {self.source.width}x{self.source.height}"
            )
