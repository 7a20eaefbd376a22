"""`ObjectVolume`: the shape and colour of one object, fused from masked frames along its poses.

A truncated signed distance function on a grid of the object's size (Curless and Levoy, SIGGRAPH 1996; Newcombe et al.,
ISMAR 2011), in NumPy. Views through a voxel to something behind it are kept apart from measurements close to the
surface: they remove what was fused wrongly, and never create a surface.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from objectflow import geometry
from objectflow.errors import FrameError
from objectflow.frame import RgbdFrame
from objectflow.geometry.camera import Camera
from objectflow.geometry.depth_noise import STRUCTURED_LIGHT, DepthNoise
from objectflow.geometry.normals import surface_normals
from objectflow.settings import Settings, setting
from objectflow.tracking.volume_grid import VolumeGrid, block_range, voxels_of_blocks
from objectflow.tracking.volume_meshing import TriangleMesh, volume_mesh
from objectflow.tracking.volume_rendering import Rendering, render_volume
from objectflow.tracking.volume_surface import SurfacePoints, surface_points
from objectflow.typing import BoolMask, Float32Array, Float64Array, IndexArray


@dataclass(frozen=True)
class VolumeSettings(Settings):
    """Resolution, weights and bounds of a volume."""

    voxel: float = setting(0.003, above=0)
    """Metres: smallest edge length of a voxel. Voxels are larger where a pixel, or the noise of depth, is."""
    truncation: float = setting(4.0, minimum=2)
    """Voxels: distance from the surface up to which measurements are fused."""
    max_voxels: int = setting(2_000_000, minimum=4096)
    """Largest number of voxels, of 24 bytes each. A larger object gets voxels of twice the edge length."""
    max_extent: float = setting(2.0, above=0)
    """Metres: depth farther than this from the centre of the first observation is ignored."""
    max_weight: float = setting(60.0, above=0)
    """Largest weight of a voxel, so that later measurements still count. A perpendicular view at the depth of the
    first observation has weight 1."""
    min_weight: float = setting(0.3, above=0)
    """Smallest weight of a voxel beside the surface."""
    min_cosine: float = setting(0.15, minimum=0, maximum=1)
    """Cosine of the angle between the surface normal and the ray, below which depth is not fused."""
    rough_weight: float = setting(0.1, minimum=0, maximum=1)
    """Weight of a pixel without a normal, relative to a perpendicular view: surfaces of a few pixels."""
    erosion: int = setting(1, minimum=0)
    """Pixels that are removed from the edge of a mask, where depth and colour mix with the background's."""
    edge_step: float = setting(0.02, above=0)
    """Depth difference to a neighbouring pixel, relative to depth, at which a pixel lies on a depth edge."""
    free_margin: int = setting(3, minimum=0)
    """Pixels around a mask that do not count as seen through."""
    free_weight: float = setting(0.25, minimum=0)
    """Weight of a view through a voxel."""
    min_component: float = setting(0.1, minimum=0, maximum=1)
    """Smallest area of a connected piece of the mesh, relative to the largest piece."""
    min_pixels: int = setting(40, minimum=1)
    """Number of usable pixels below which a mask is not fused."""


class ObjectVolume:
    """A volume that grows with what is seen of one object. It can be pickled.

    Attributes:
        settings: see `VolumeSettings`.
        noise: of the depth camera.
        frames: number of frames fused.
        grid: the voxels; None before the first frame.
    """

    def __init__(self, settings: VolumeSettings | None = None, noise: DepthNoise = STRUCTURED_LIGHT) -> None:
        self.settings = settings or VolumeSettings()
        self.noise = noise
        self.frames = 0
        self.grid: VolumeGrid | None = None
        self._center = np.zeros(3)
        self._first_sigma = 1.0
        self._surface: SurfacePoints | None = None

    @property
    def truncation(self) -> float:
        """Truncation distance in metres; 0 before the first frame."""
        return 0.0 if self.grid is None else self.settings.truncation * self.grid.voxel

    def integrate(
        self,
        frame: RgbdFrame,
        mask: BoolMask,
        camera_T_object: Float64Array,
        *,
        free: BoolMask | None = None,
    ) -> int:
        """Fuse the masked part of a frame.

        Args:
            frame: colour and depth.
            mask: (H, W) bool: the object's pixels.
            camera_T_object: (4, 4) pose of the object frame in the camera frame.
            free: (H, W) bool: pixels that certainly do not show the object: whatever lies in front of their depth is
                empty. None for all pixels away from the mask.

        Returns:
            The number of pixels fused; 0 if there are fewer than `min_pixels`, in which case nothing changes.

        Raises:
            FrameError: the mask or `free` differs from the frame in size.
        """
        for one in (mask, free):
            if one is not None and one.shape != frame.depth.shape:
                raise FrameError(f"a mask {one.shape} does not fit the frame {frame.depth.shape}")
        own = self._usable(frame.depth, mask)
        object_T_camera = geometry.inverse(camera_T_object)
        if self.grid is None:
            own &= self._start(frame, own, object_T_camera)
        rows, columns = np.nonzero(own)
        depth = frame.depth[rows, columns].astype(np.float64)
        pixels = np.stack([columns, rows], axis=1)
        points = geometry.transform(object_T_camera, geometry.back_project_pixels(pixels, depth, frame.camera))
        inside = np.abs(points - self._center).max(axis=1, initial=0) < self.settings.max_extent
        own[rows[~inside], columns[~inside]] = False
        points = points[inside]
        if len(points) < self.settings.min_pixels or self.grid is None:
            return 0
        self._grow(points.min(axis=0), points.max(axis=0))
        if free is None:
            size = 2 * self.settings.free_margin + 1
            free = cv2.dilate(mask.astype(np.uint8), np.ones((size, size), np.uint8)) == 0
        self._fuse(frame, own, free & frame.valid, points, camera_T_object)
        self.frames += 1
        self._surface = None
        return len(points)

    def surface(self) -> SurfacePoints:
        """The points at which the signed distance crosses zero: about one per voxel of the surface."""
        if self.grid is None:
            empty = np.zeros((0, 3), np.float32)
            return SurfacePoints(empty, empty, np.zeros((0, 3), np.uint8))
        if self._surface is None:
            self._surface = surface_points(self.grid, self.truncation, self.settings.min_weight)
        return self._surface

    def mesh(self) -> TriangleMesh:
        """The surface as a coloured mesh, without small detached pieces; see `volume_mesh`.

        Raises:
            MissingExtraError: scikit-image is not installed.
        """
        grid = VolumeGrid.empty(1.0, np.zeros(3, np.intp), (8, 8, 8)) if self.grid is None else self.grid
        return volume_mesh(grid, self.truncation, self.settings.min_weight, self.settings.min_component)

    def render(self, camera: Camera, camera_T_object: Float64Array) -> Rendering:
        """What a camera sees of the surface; see `render_volume`."""
        return render_volume(self.grid, self.surface(), self.truncation, camera, camera_T_object)

    def _usable(self, depth: Float32Array, mask: BoolMask) -> BoolMask:
        """The masked pixels that are away from the mask's edge and from depth edges."""
        settings = self.settings
        size = np.ones((2 * settings.erosion + 1,) * 2, np.uint8)
        own = cv2.erode((mask & (depth > 0)).astype(np.uint8), size, borderValue=0) > 0
        near = cv2.erode(np.where(depth > 0, depth, np.float32(np.inf)), np.ones((3, 3), np.uint8))
        far = cv2.dilate(depth, np.ones((3, 3), np.uint8))
        smooth = (far - depth < settings.edge_step * depth) & (depth - near < settings.edge_step * depth)
        return np.asarray(own & smooth)

    def _start(self, frame: RgbdFrame, own: BoolMask, object_T_camera: Float64Array) -> bool:
        """Choose the voxel size and the centre by the first observation; False if it is too small."""
        rows, columns = np.nonzero(own)
        if len(rows) < self.settings.min_pixels:
            return False
        depth = frame.depth[rows, columns].astype(np.float64)
        middle = float(np.median(depth))
        sigma = float(self.noise.sigma(middle))
        voxel = max(self.settings.voxel, middle / min(frame.camera.fx, frame.camera.fy), sigma)
        pixels = np.stack([columns, rows], axis=1)
        points = geometry.transform(object_T_camera, geometry.back_project_pixels(pixels, depth, frame.camera))
        self._center = np.median(points, axis=0)
        self._first_sigma = sigma
        first, _ = block_range(self._center, self._center, voxel)
        self.grid = VolumeGrid.empty(voxel, first, (8, 8, 8))
        return True

    def _grow(self, lower: Float64Array, upper: Float64Array) -> None:
        """Let the grid cover a box and its truncation distance; coarsen it where it would have too many voxels."""
        assert self.grid is not None
        while True:
            margin = self.truncation + self.grid.voxel
            start, stop = block_range(lower - margin, upper + margin, self.grid.voxel)
            start = np.minimum(start, self.grid.first)
            stop = np.maximum(stop, self.grid.first + self.grid.shape)
            if int(np.prod(stop - start)) <= self.settings.max_voxels:
                break
            self.grid = self.grid.coarser()
        self.grid = self.grid.covering(lower - margin, upper + margin)

    def _fuse(
        self, frame: RgbdFrame, own: BoolMask, free: BoolMask, points: Float64Array, camera_T_object: Float64Array
    ) -> None:
        """Update the voxels near the points (N, 3), object frame, and all measured ones that are seen through."""
        assert self.grid is not None
        grid, settings, camera = self.grid, self.settings, frame.camera
        index = voxels_of_blocks(grid.near_points(points) | grid.observed_blocks())
        R, t = camera_T_object[:3, :3].astype(np.float32), camera_T_object[:3, 3].astype(np.float32)
        centers = R @ grid.centers(index) + t[:, None]
        z = np.maximum(centers[2], np.float32(1e-6))
        column = np.rint(centers[0] / z * np.float32(camera.fx) + np.float32(camera.cx))
        row = np.rint(centers[1] / z * np.float32(camera.fy) + np.float32(camera.cy))
        seen = (column >= 0) & (row >= 0) & (column < camera.width) & (row < camera.height) & (centers[2] > 1e-3)
        index, centers, z = index[seen], centers[:, seen], z[seen]
        pixel = row[seen].astype(np.intp) * camera.width + column[seen].astype(np.intp)
        depth = frame.depth.ravel()[pixel]
        own_pixel, free_pixel = own.ravel()[pixel], free.ravel()[pixel]
        near = own_pixel & (np.abs(depth - z) < 2 * self.truncation)
        self._fuse_near(frame, index[near], centers[:, near], pixel[near])
        # Twice the truncation distance and the noise: clearly behind the voxel.
        behind = depth - z > 2 * self.truncation + 3 * self.noise.sigma(depth)
        through = index[(own_pixel | free_pixel) & behind]
        views = grid.free.reshape(-1)
        views[through] = np.minimum(views[through] + np.float32(settings.free_weight), settings.max_weight)

    def _fuse_near(self, frame: RgbdFrame, index: IndexArray, centers: Float32Array, pixel: IndexArray) -> None:
        """Average signed distances and colours into voxels.

        Args:
            frame: the frame.
            index: (N,) flat indices of the voxels.
            centers: (3, N) their centres in the camera frame.
            pixel: (N,) flat indices of the pixels that they project to.
        """
        assert self.grid is not None
        grid, settings = self.grid, self.settings
        points = geometry.back_project(frame.depth, frame.camera).reshape(-1, 3).take(pixel, axis=0).T
        normals = surface_normals(frame.depth, frame.camera).reshape(-1, 3).take(pixel, axis=0).T
        rays = points / np.linalg.norm(points, axis=0)
        cosine = -(normals * rays).sum(axis=0)
        rough = ~np.isfinite(cosine)
        # The distance to the tangent plane is exact for planes at any angle; the distance along the ray is not.
        signed = np.where(rough, points[2] - centers[2], (normals * (centers - points)).sum(axis=0))
        weight = np.where(rough, settings.rough_weight, cosine)
        weight = weight * (self._first_sigma / self.noise.sigma(points[2])) ** 2
        used = (np.abs(signed) <= self.truncation) & (rough | (cosine >= settings.min_cosine))
        index, signed, weight = index[used], signed[used], weight[used].astype(np.float32)
        distances, weights, colors = grid.distance.reshape(-1), grid.weight.reshape(-1), grid.color.reshape(-1, 3)
        old = weights[index]
        total = old + weight
        distances[index] = (distances[index] * old + signed * weight) / total
        shade = frame.color.reshape(-1, 3)[pixel[used]].astype(np.float32)
        colors[index] = (colors[index] * old[:, None] + shade * weight[:, None]) / total[:, None]
        weights[index] = np.minimum(total, np.float32(settings.max_weight))
