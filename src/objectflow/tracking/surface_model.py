"""The surface of one object, accumulated over frames in a grid of voxels of bounded size."""

from __future__ import annotations

import itertools

import cv2
import numpy as np
from numpy.typing import NDArray

from objectflow import geometry
from objectflow.alignment.prepared_frame import PreparedFrame
from objectflow.geometry.camera import Camera
from objectflow.typing import BoolMask, Float64Array, Int64Array

_REACH = 1 << 20
"""Voxels: the coordinates of a voxel lie in -_REACH.._REACH, so that three of them fit one 64-bit key."""
_MAX_RADIUS = 8
"""Pixels: largest extent of a voxel in a rendered image."""
_MAX_TILT = 4.0
"""Largest slope of a voxel's tangent plane in a rendered image, metres of depth per metre across the ray."""
_POINT, _NORMAL, _COLOR = slice(0, 3), slice(3, 6), slice(6, 9)


class SurfaceModel:
    """Mean point, normal and colour of every voxel that the object's surface was seen in.

    A voxel also counts how often it moved with the object (`kept`) and how often the camera looked through it or saw
    something else there (`missed`), so that parts of the background that a mask contained disappear again.

    Attributes:
        voxel: edge length of a voxel, metres. It doubles where the model would exceed `max_points`.
        max_points: maximum number of voxels.
    """

    def __init__(self, voxel: float, max_points: int) -> None:
        self.voxel, self.max_points = voxel, max_points
        self._keys: Int64Array = np.zeros(0, np.int64)
        self._sums: Float64Array = np.zeros((0, 9))
        self._counts: Float64Array = np.zeros((0, 3))
        """(N, 3): measurements, `kept` and `missed`."""

    def __len__(self) -> int:
        """The number of voxels."""
        return len(self._keys)

    @property
    def points(self) -> Float64Array:
        """(N, 3) metres in the object frame."""
        return self._sums[:, _POINT] / self._counts[:, :1]

    @property
    def colors(self) -> Float64Array:
        """(N, 3) RGB, 0..255."""
        return self._sums[:, _COLOR] / self._counts[:, :1]

    def integrate(self, frame: PreparedFrame, mask: BoolMask, camera_T_object: Float64Array) -> None:
        """Add the surface in a mask.

        Args:
            frame: provides points, normals and colours.
            mask: (H, W) bool; pixels without depth are left out.
            camera_T_object: (4, 4) the object's pose.
        """
        rows, columns = np.nonzero(mask & frame.valid)
        points = frame.points[rows, columns].astype(np.float64)
        normals = frame.normals[rows, columns].astype(np.float64)
        # Edges have no normal; the direction to the camera says from where they are visible.
        toward = -points / np.linalg.norm(points, axis=1, keepdims=True)
        normals = np.where(np.isfinite(normals).all(axis=1, keepdims=True), normals, toward)
        object_T_camera = geometry.inverse(camera_T_object)
        values = np.concatenate(
            [
                geometry.transform(object_T_camera, points),
                normals @ object_T_camera[:3, :3].T,
                frame.frame.color[rows, columns].astype(np.float64),
            ],
            axis=1,
        )
        self._add(values, np.tile([1.0, 0.0, 0.0], (len(values), 1)))

    def add(self, other: SurfaceModel, own_T_other: Float64Array) -> None:
        """Add the voxels of another model.

        Args:
            other: the model.
            own_T_other: (4, 4) from its frame to that of this one.
        """
        counts = other._counts[:, :1]
        points = geometry.transform(own_T_other, other.points) * counts
        normals = other._sums[:, _NORMAL] @ own_T_other[:3, :3].T
        self._add(np.concatenate([points, normals, other._sums[:, _COLOR]], axis=1), other._counts)

    def count(self, kept: BoolMask, missed: BoolMask) -> None:
        """Count which voxels moved with the object, and remove those that were missed more often than kept.

        Args:
            kept, missed: (N,) bool.
        """
        self._counts[:, 1] += kept
        self._counts[:, 2] += missed
        chosen = self._counts[:, 2] <= self._counts[:, 1]
        self._keys, self._sums, self._counts = self._keys[chosen], self._sums[chosen], self._counts[chosen]

    def take(self, chosen: BoolMask) -> SurfaceModel:
        """Take voxels out of the model.

        Args:
            chosen: (N,) bool.

        Returns:
            The model of these voxels, in the same frame.
        """
        part = SurfaceModel(self.voxel, self.max_points)
        part._keys, part._sums, part._counts = self._keys[chosen], self._sums[chosen], self._counts[chosen]
        kept = ~chosen
        self._keys, self._sums, self._counts = self._keys[kept], self._sums[kept], self._counts[kept]
        return part

    def render(self, camera_T_object: Float64Array, frame: PreparedFrame) -> tuple[NDArray[np.float32], Int64Array]:
        """Render the surface that faces the camera.

        Args:
            camera_T_object: (4, 4) the object's pose.
            frame: provides the camera.

        Returns:
            (H, W) float32 depth in metres, infinite beside the object; and (H, W) int64 the index of the voxel, -1
            beside it.
        """
        camera = frame.frame.camera
        depth = np.full((camera.height, camera.width), np.inf, np.float32)
        index = np.full((camera.height, camera.width), -1, np.int64)
        numbers = np.flatnonzero(self.facing(camera_T_object))
        points = geometry.transform(camera_T_object, self.points[numbers])
        pixels = np.rint(geometry.project(points, camera))
        near = (np.abs(pixels) < 1e6).all(axis=1)
        numbers, points, pixels = numbers[near], points[near], pixels[near].astype(np.int64)
        if not len(numbers):
            return depth, index
        # A voxel covers the pixels around its centre, so that the surface has no holes.
        size = self.voxel * camera.fx / float(np.median(points[:, 2]))
        radius = min(_MAX_RADIUS, max(1, int(np.ceil(0.75 * size))))
        # The window has an empty margin of a pixel, which erosion needs; at the image border it has none.
        low = np.maximum(pixels.min(axis=0) - radius - 1, 0)
        high = np.minimum(pixels.max(axis=0) + radius + 2, [camera.width, camera.height])
        if (high <= low).any():
            return depth, index
        width, height = (high - low).tolist()
        normals = self._sums[numbers, _NORMAL] @ camera_T_object[:3, :3].T
        depths, owners = _splat(points, normals, pixels - low, (height, width), radius, self.voxel, camera, low)
        # Erosion takes back what the voxels' extent added at the outline.
        kernel = np.ones((2 * radius + 1, 2 * radius + 1), np.uint8)
        filled = np.isfinite(depths).astype(np.uint8)
        inner = cv2.erode(filled, kernel, borderType=cv2.BORDER_REPLICATE).astype(bool)
        box = (slice(low[1], high[1]), slice(low[0], high[0]))
        depth[box] = np.where(inner, depths, np.inf)
        index[box] = np.where(inner, numbers[owners], -1)
        return depth, index

    def facing(self, camera_T_object: Float64Array) -> BoolMask:
        """(N,) bool: the voxels in front of the camera whose surface faces it."""
        points = geometry.transform(camera_T_object, self.points)
        normals = self._sums[:, _NORMAL] @ camera_T_object[:3, :3].T
        return np.asarray(((points * normals).sum(axis=1) < 0) & (points[:, 2] > 0.01))

    def grays(self) -> NDArray[np.float32]:
        """(N,) grey levels."""
        rgb = np.clip(np.rint(self.colors), 0, 255).astype(np.uint8).reshape(-1, 1, 3)
        return cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY).reshape(-1).astype(np.float32) if len(rgb) else np.zeros(0, "f4")

    def _add(self, values: Float64Array, counts: Float64Array) -> None:
        """Add sums of points, normals and colours (N, 9), with their counts (N, 3)."""
        keys = self._key(values[:, _POINT] / counts[:, :1])
        self._keys, self._sums, self._counts = _merged(
            np.concatenate([self._keys, keys]),
            np.concatenate([self._sums, values]),
            np.concatenate([self._counts, counts]),
        )
        while len(self._keys) > self.max_points:
            self.voxel *= 2
            self._keys, self._sums, self._counts = _merged(self._key(self.points), self._sums, self._counts)

    def _key(self, points: Float64Array) -> Int64Array:
        cells = np.clip(np.floor(points / self.voxel).astype(np.int64), -_REACH + 1, _REACH - 1) + _REACH
        return np.asarray((cells[:, 0] << 42) | (cells[:, 1] << 21) | cells[:, 2])


def new_model(frame: PreparedFrame, mask: BoolMask, camera_T_object: Float64Array, max_points: int) -> SurfaceModel:
    """A model of the surface in a mask, with voxels that suit its distance.

    Args:
        frame: provides points, normals and colours.
        mask: (H, W) bool, with depth at one pixel at least.
        camera_T_object: (4, 4) the object's pose.
        max_points: maximum number of voxels.
    """
    depth = float(np.median(frame.frame.depth[mask & frame.valid]))
    # Two pixels: at one, noise would spread a surface over several voxels.
    model = SurfaceModel(2 * depth / frame.frame.camera.fx, max_points)
    model.integrate(frame, mask, camera_T_object)
    return model


def _splat(
    points: Float64Array,
    normals: Float64Array,
    pixels: Int64Array,
    shape: tuple[int, int],
    radius: int,
    voxel: float,
    camera: Camera,
    corner: Int64Array,
) -> tuple[NDArray[np.float32], Int64Array]:
    """Depth and owner of each pixel from squares of tangent planes.

    Args:
        points, normals: (N, 3) metres and directions in the camera frame.
        pixels: (N, 2) the pixel (u, v) of each point in the window.
        shape: (H, W) of the window.
        radius: pixels around a point that it covers.
        voxel: metres: points up to twice as far behind the nearest one belong to the same surface.
        camera: of the image.
        corner: (2,) pixel (u, v) of the window's corner in the image.

    Returns:
        (H, W) float32 metres, infinite on empty pixels; and (H, W) int64 the index of the point, 0 on empty pixels.
    """
    height, width = shape
    distance = (normals * points).sum(axis=1)
    reach = _MAX_TILT * radius * points[:, 2] / camera.fx
    nearest = np.full(height * width, np.inf, np.float32)
    splats = []
    for dv, du in itertools.product(range(-radius, radius + 1), repeat=2):
        u, v = (pixels + np.array([du, dv])).T
        which = np.flatnonzero((u >= 0) & (v >= 0) & (u < width) & (v < height))
        at, x, y = v[which] * width + u[which], u[which] + corner[0] - camera.cx, v[which] + corner[1] - camera.cy
        # The depth of the point's tangent plane on the pixel's ray.
        along = normals[which, 0] * (x / camera.fx) + normals[which, 1] * (y / camera.fy) + normals[which, 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            plane = np.nan_to_num(distance[which] / along, nan=np.inf)
        z = np.clip(plane, points[which, 2] - reach[which], points[which, 2] + reach[which]).astype(np.float32)
        np.minimum.at(nearest, at, z)
        splats.append((du * du + dv * dv, at, which, z))
    # Of the points of the front surface, the one closest to the ray counts: the nearest one would bias the depth by
    # its noise. It is assigned last.
    depths, owners = np.full(height * width, np.inf, np.float32), np.zeros(height * width, np.int64)
    for _, at, which, z in sorted(splats, key=lambda splat: -splat[0]):
        front = z <= nearest[at] + 2 * voxel
        depths[at[front]], owners[at[front]] = z[front], which[front]
    return depths.reshape(shape), owners.reshape(shape)


def _merged(
    keys: Int64Array, sums: Float64Array, counts: Float64Array
) -> tuple[Int64Array, Float64Array, Float64Array]:
    """Sum the rows of equal keys; `kept` and `missed` are those of the voxel that has more of them."""
    unique, inverse = np.unique(keys, return_inverse=True)
    summed, total = np.zeros((len(unique), sums.shape[1])), np.zeros((len(unique), 3))
    np.add.at(summed, inverse, sums)
    np.add.at(total[:, 0], inverse, counts[:, 0])
    np.maximum.at(total[:, 1], inverse, counts[:, 1])
    np.maximum.at(total[:, 2], inverse, counts[:, 2])
    return unique, summed, total
