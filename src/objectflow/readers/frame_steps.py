"""Steps between decoded images and a frame: other image sizes, another depth camera, ray length."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from objectflow.errors import FrameError
from objectflow.geometry.camera import Camera
from objectflow.geometry.resample import resize_nearest
from objectflow.typing import Float32Array, UInt8Array


@dataclass(frozen=True)
class DepthAtColor:
    """Brings depth of another size, but of the same field of view, to the pixels of colour by the nearest value.

    Attributes:
        depth_size: (width, height) of depth.
    """

    depth_size: tuple[int, int]

    def __call__(self, color: UInt8Array, depth: Float32Array) -> tuple[UInt8Array, Float32Array]:
        """Resample depth."""
        _check_size(depth, self.depth_size, "depth")
        return color, resize_nearest(depth, color.shape[:2])


@dataclass(frozen=True)
class ColorAtDepth:
    """Resamples colour to the pixels of a depth camera that has the same centre and orientation as the colour camera.

    Attributes:
        color_camera: the camera of the stored colour images.
        depth_camera: the camera of depth, which becomes the camera of the frame.
    """

    color_camera: Camera
    depth_camera: Camera

    def __call__(self, color: UInt8Array, depth: Float32Array) -> tuple[UInt8Array, Float32Array]:
        """Resample colour; pixels outside the colour image have no depth."""
        source, target = self.color_camera, self.depth_camera
        _check_size(color, (source.width, source.height), "colour")
        _check_size(depth, (target.width, target.height), "depth")
        u = (np.arange(target.width) - target.cx) / target.fx * source.fx + source.cx
        v = (np.arange(target.height) - target.cy) / target.fy * source.fy + source.cy
        if source.fx > 1.5 * target.fx:
            # An image that is reduced by linear interpolation alone aliases.
            sigma = (0.4 * source.fx / target.fx, 0.4 * source.fy / target.fy)
            color = np.asarray(cv2.GaussianBlur(color, (0, 0), sigmaX=sigma[0], sigmaY=sigma[1]), dtype=np.uint8)
        map_u, map_v = np.meshgrid(u.astype(np.float32), v.astype(np.float32))
        remapped = cv2.remap(color, map_u, map_v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        inside_u = (u >= -0.5) & (u <= source.width - 0.5)
        inside_v = (v >= -0.5) & (v <= source.height - 0.5)
        seen = inside_v[:, None] & inside_u[None, :]
        return np.asarray(remapped, dtype=np.uint8), np.where(seen, depth, np.float32(0)).astype(np.float32)


@dataclass(frozen=True)
class PlanarDepth:
    """Converts distance along each ray into planar z.

    Attributes:
        camera: of depth.
    """

    camera: Camera

    def __call__(self, color: UInt8Array, depth: Float32Array) -> tuple[UInt8Array, Float32Array]:
        """Convert depth."""
        camera = self.camera
        _check_size(depth, (camera.width, camera.height), "depth")
        x = (np.arange(camera.width) - camera.cx) / camera.fx
        y = (np.arange(camera.height) - camera.cy) / camera.fy
        length = np.sqrt(1 + x[None, :] ** 2 + y[:, None] ** 2)
        return color, (depth / length).astype(np.float32)


def _check_size(image: UInt8Array | Float32Array, size: tuple[int, int], name: str) -> None:
    height, width = image.shape[:2]
    if (width, height) != size:
        raise FrameError(f"{name} is {width}x{height}, in the other frames {size[0]}x{size[1]}")
