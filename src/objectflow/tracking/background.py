"""The static rest of a scene: points averaged per voxel over the frames of a sequence."""

from __future__ import annotations

import numpy as np

from objectflow import geometry
from objectflow.frame import RgbdFrame
from objectflow.geometry.normals import surface_normals
from objectflow.tracking.volume_surface import SurfacePoints
from objectflow.typing import BoolMask, Float64Array, Int64Array

MAX_POINTS = 1_000_000
"""Largest number of points; the voxels grow where there would be more."""
MAX_DEPTH = 6.0
"""Metres: depth beyond it is not fused."""
MIN_VIEWS = 2
"""Number of measurements below which a voxel is left out, once there are several frames."""
_BITS = 20
"""Bits of each coordinate in a voxel's key."""


class BackgroundCloud:
    """Averages of position, normal and colour in voxels of the world.

    Attributes:
        voxel: edge length, metres; it doubles where there would be too many points.
        frames: number of frames added.
    """

    def __init__(self, voxel: float) -> None:
        self.voxel = voxel
        self.frames = 0
        self._keys: Int64Array = np.zeros(0, np.int64)
        # Sums of position (3), normal (3) and colour (3), and the number of measurements.
        self._sums: Float64Array = np.zeros((0, 10))

    def add(self, frame: RgbdFrame, mask: BoolMask, world_T_camera: Float64Array) -> None:
        """Add the masked pixels of a frame.

        Args:
            frame: colour and depth.
            mask: (H, W) bool: static pixels.
            world_T_camera: (4, 4).
        """
        normals = surface_normals(frame.depth, frame.camera)
        rows, columns = np.nonzero(mask & np.isfinite(normals[..., 2]) & (frame.depth < MAX_DEPTH))
        depth = frame.depth[rows, columns].astype(np.float64)
        points = geometry.back_project_pixels(np.stack([columns, rows], axis=1), depth, frame.camera)
        points = geometry.transform(world_T_camera, points)
        upright = normals[rows, columns].astype(np.float64) @ world_T_camera[:3, :3].T
        count = np.ones((len(points), 1))
        self._merge(self._key(points), np.hstack([points, upright, frame.color[rows, columns], count]))
        while len(self._keys) > MAX_POINTS:
            self.voxel *= 2
            centers = self._sums[:, :3] / self._sums[:, 9:]
            sums, self._keys, self._sums = self._sums, self._keys[:0], self._sums[:0]
            self._merge(self._key(centers), sums)
        self.frames += 1

    def points(self) -> SurfacePoints:
        """The averages, ordered by voxel, in the world frame."""
        sums = self._sums[self._sums[:, 9] >= MIN_VIEWS] if self.frames >= MIN_VIEWS else self._sums
        means = sums / sums[:, 9:]
        normals = means[:, 3:6] / (np.linalg.norm(means[:, 3:6], axis=1, keepdims=True) + 1e-12)
        colors = np.clip(np.rint(means[:, 6:9]), 0, 255).astype(np.uint8)
        return SurfacePoints(means[:, :3].astype(np.float32), normals.astype(np.float32), colors)

    def _key(self, points: Float64Array) -> Int64Array:
        """(N,) one integer for the voxel of each point."""
        half = 1 << (_BITS - 1)
        cells = np.clip(np.floor(points / self.voxel).astype(np.int64) + half, 0, 2 * half - 1)
        return np.asarray((cells[:, 0] << (2 * _BITS)) | (cells[:, 1] << _BITS) | cells[:, 2])

    def _merge(self, keys: Int64Array, sums: Float64Array) -> None:
        keys, sums = np.concatenate([self._keys, keys]), np.concatenate([self._sums, sums])
        self._keys, inverse = np.unique(keys, return_inverse=True)
        columns = [np.bincount(inverse, weights=sums[:, k], minlength=len(self._keys)) for k in range(sums.shape[1])]
        self._sums = np.stack(columns, axis=1)
