"""Registration of depth to the pixels of a colour camera at another position."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from objectflow.errors import FrameError
from objectflow.geometry.camera import Camera
from objectflow.typing import BoolMask, Float32Array, Float64Array, UInt8Array


@dataclass(frozen=True)
class RegistrationSettings:
    """Thresholds of the registration.

    Attributes:
        same_surface: largest relative difference in depth between neighbours on one surface.
        refinements: number of steps that move the depth of a colour pixel to its own line of sight.
        max_footprint: largest number of colour pixels that one depth pixel covers, along each axis.
    """

    same_surface: float = 0.03
    refinements: int = 2
    max_footprint: int = 8


class DepthRegistration:
    """Brings depth to the pixels of a colour camera: visible surfaces hide those behind them, unseen pixels are 0.

    Each depth pixel covers the rectangle of colour pixels that its corners project to, and the nearest surface wins.
    The depth of each colour pixel is then interpolated at the point where its line of sight meets the surface.

    Args:
        depth_camera, color_camera: pinhole cameras.
        color_T_depth: (4, 4) from the frame of the depth camera to that of the colour camera.
        settings: thresholds.
    """

    def __init__(
        self,
        depth_camera: Camera,
        color_camera: Camera,
        color_T_depth: Float64Array,
        settings: RegistrationSettings | None = None,
    ) -> None:
        self.depth_camera = depth_camera
        self.color_camera = color_camera
        self.settings = settings or RegistrationSettings()
        R, t = color_T_depth[:3, :3], color_T_depth[:3, 3]
        corners = _rays(
            depth_camera, np.arange(depth_camera.width + 1) - 0.5, np.arange(depth_camera.height + 1) - 0.5
        )
        self._corner_rays = (corners @ R.T).astype(np.float32)
        centers = _rays(depth_camera, np.arange(depth_camera.width), np.arange(depth_camera.height))
        # Depth along the optical axis of the colour camera, per metre of depth.
        self._z_rays = (centers @ R[2]).astype(np.float32)
        self._t = t.astype(np.float32)
        rays = _rays(color_camera, np.arange(color_camera.width), np.arange(color_camera.height))
        self._color_rays = rays.reshape(-1, 3).astype(np.float32)
        self._R = R.astype(np.float32)

    def __call__(self, color: UInt8Array, depth: Float32Array) -> tuple[UInt8Array, Float32Array]:
        """Register depth (h, w) to colour (H, W, 3).

        Raises:
            FrameError: depth has another size than its camera.
        """
        if depth.shape != (self.depth_camera.height, self.depth_camera.width):
            raise FrameError(
                f"depth is {depth.shape[1]}x{depth.shape[0]}, its camera is "
                f"{self.depth_camera.width}x{self.depth_camera.height}"
            )
        registered = self._splat(depth)
        for _ in range(self.settings.refinements):
            registered = self._refine(registered, depth)
        return color, registered.reshape(self.color_camera.height, self.color_camera.width)

    def _splat(self, depth: Float32Array) -> Float32Array:
        """The nearest depth over every colour pixel, (H * W,) metres."""
        camera = self.color_camera
        rows, columns = np.nonzero(depth > 0)
        z = depth[rows, columns]
        corners = [
            self._project(self._corner_rays[rows + row, columns + column], z) for row in (0, 1) for column in (0, 1)
        ]
        color_z = self._z_rays[rows, columns] * z + self._t[2]
        low, high = np.ceil(np.min(corners, axis=0)), np.ceil(np.max(corners, axis=0))
        in_front = (color_z > 0) & np.isfinite(low).all(axis=1) & np.isfinite(high).all(axis=1)
        seen = in_front & (high > 0).all(axis=1) & (low < (camera.width, camera.height)).all(axis=1)
        low, color_z = low[seen].astype(np.int64), color_z[seen]
        extent = np.minimum(high[seen].astype(np.int64) - low, self.settings.max_footprint)
        order = np.argsort(-color_z)  # nearer surfaces overwrite farther ones
        low, extent, color_z = low[order], extent[order], color_z[order]
        nearest = np.full(camera.height * camera.width, np.inf, np.float32)
        width, height = extent.max(axis=0, initial=0).tolist()
        for dv in range(height):
            for du in range(width):
                u, v = low[:, 0] + du, low[:, 1] + dv
                covered = (du < extent[:, 0]) & (dv < extent[:, 1]) & (u >= 0) & (v >= 0)
                covered &= (u < camera.width) & (v < camera.height)
                layer = np.full_like(nearest, np.inf)
                layer[v[covered] * camera.width + u[covered]] = color_z[covered]
                np.minimum(nearest, layer, out=nearest)
        return np.where(np.isfinite(nearest), nearest, np.float32(0))

    def _project(self, rays: Float32Array, z: Float32Array) -> Float32Array:
        """Colour pixels (N, 2) of points along turned rays of the depth camera; not finite behind the camera."""
        camera = self.color_camera
        points = rays * z[:, None] + self._t
        with np.errstate(divide="ignore", invalid="ignore"):
            scale = np.where(points[:, 2] > 0, 1 / points[:, 2], np.float32(np.nan))
        u, v = points[:, 0] * scale * camera.fx + camera.cx, points[:, 1] * scale * camera.fy + camera.cy
        return np.column_stack([u, v]).astype(np.float32)

    def _refine(self, registered: Float32Array, depth: Float32Array) -> Float32Array:
        """Depth of the point that each colour pixel sees; splatted depth is that of a point beside it."""
        camera = self.depth_camera
        pixels = np.flatnonzero(registered > 0)
        points = self._color_rays[pixels] * registered[pixels, None]
        # The inverse of the rotation is its transpose, and rows times R apply it.
        inside = (points - self._t) @ self._R
        with np.errstate(divide="ignore", invalid="ignore"):
            x, y = inside[:, 0] / inside[:, 2], inside[:, 1] / inside[:, 2]
        u, v = (x * camera.fx + camera.cx).astype(np.float32), (y * camera.fy + camera.cy).astype(np.float32)
        usable = (inside[:, 2] > 0) & (u >= 0) & (v >= 0) & (u <= camera.width - 1) & (v <= camera.height - 1)
        pixels, x, y, expected = pixels[usable], x[usable], y[usable], inside[usable, 2]
        z, known = self._interpolate(depth, u[usable], v[usable], expected)
        color_z = (self._R[2, 0] * x + self._R[2, 1] * y + self._R[2, 2]) * z + self._t[2]
        refined = registered.copy()
        refined[pixels[known]] = color_z[known]
        return refined

    def _interpolate(
        self, depth: Float32Array, u: Float32Array, v: Float32Array, expected: Float32Array
    ) -> tuple[Float32Array, BoolMask]:
        """Depth at fractional pixels, and where all four neighbours lie on the expected surface.

        Inverse depth is interpolated, which is linear over the image of a plane.
        """
        height, width = depth.shape
        left = np.minimum(u.astype(np.intp), max(0, width - 2))
        top = np.minimum(v.astype(np.intp), max(0, height - 2))
        du, dv = (u - left).astype(np.float32), (v - top).astype(np.float32)
        right, below = np.minimum(left + 1, width - 1), np.minimum(top + 1, height - 1)
        inverse = np.zeros_like(expected)
        known = np.ones(len(expected), bool)
        for row, column, weight in (
            (top, left, (1 - du) * (1 - dv)),
            (top, right, du * (1 - dv)),
            (below, left, (1 - du) * dv),
            (below, right, du * dv),
        ):
            z = depth[row, column]
            known &= np.abs(z - expected) <= self.settings.same_surface * expected
            with np.errstate(divide="ignore", invalid="ignore"):
                inverse += weight / z
        with np.errstate(divide="ignore", invalid="ignore"):
            return (1 / inverse).astype(np.float32), known


def _rays(camera: Camera, u: NDArray[Any], v: NDArray[Any]) -> Float64Array:
    """Rays (len(v), len(u), 3) with z = 1 through pixels at columns u and rows v."""
    x, y = np.meshgrid((u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy)
    return np.stack([x, y, np.ones_like(x)], axis=-1)
