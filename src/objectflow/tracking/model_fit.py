"""Comparison of an object's model with a frame, and registration of the model to the frame."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np

from objectflow import geometry
from objectflow.alignment.prepared_frame import PreparedFrame
from objectflow.alignment.registration import RegistrationSource, RegistrationTarget, refine
from objectflow.geometry.depth_noise import STRUCTURED_LIGHT, DepthNoise
from objectflow.tracking.known_settings import KnownSettings
from objectflow.tracking.pose_cost import Chroma, is_better, pose_costs
from objectflow.tracking.surface_model import SurfaceModel
from objectflow.typing import BoolMask, Float32Array, Float64Array, IndexArray


class ModelFit(NamedTuple):
    """How a model fits a frame at a pose; each array is (N,) bool over the voxels of the model.

    Attributes:
        facing: in the image and facing the camera.
        fits: depth and colour agree with the frame.
        hidden: the frame shows a nearer surface.
        missing: the frame shows a farther surface, or another colour at the same depth.
    """

    facing: BoolMask
    fits: BoolMask
    hidden: BoolMask
    missing: BoolMask

    @property
    def present(self) -> float:
        """Share of the visible points that the frame confirms, 0..1."""
        return float(self.fits.sum() / max(1, (self.fits | self.missing).sum()))

    @property
    def visible(self) -> float:
        """Share of the facing points that nothing hides, 0..1."""
        return float((self.fits | self.missing).sum() / max(1, self.facing.sum()))


class FrameView:
    """The current frame at the width at which models are compared with it.

    Attributes:
        frame: the prepared frame.
        noise: of its depth.
        chroma: (H, W, 2) float32, the colour-opponent channels of CIELAB, slightly blurred.
    """

    def __init__(self, frame: PreparedFrame, settings: KnownSettings, noise: DepthNoise = STRUCTURED_LIGHT) -> None:
        self.frame, self.settings, self.noise = frame.at_width(settings.width), settings, noise
        self.chroma = chroma(cv2.GaussianBlur(self.frame.frame.color, (0, 0), settings.color_blur))
        self._target: RegistrationTarget | None = None

    @property
    def target(self) -> RegistrationTarget:
        """The frame as the target of registration."""
        if self._target is None:
            self._target = RegistrationTarget(self.frame, self.noise)
        return self._target

    def tolerance(self, z: Float32Array | Float64Array) -> Float64Array:
        """Metres: largest difference of depth between a model and the frame at depths z."""
        return self.settings.depth_sigmas * self.noise.sigma(z).astype(np.float64) + self.settings.depth_margin

    def fit(self, model: SurfaceModel, camera_T_object: Float64Array) -> ModelFit:
        """Compare a model with the frame.

        Args:
            model: of the object.
            camera_T_object: (4, 4) its pose.
        """
        camera, depth = self.frame.frame.camera, self.frame.frame.depth
        count = len(model)
        points = geometry.transform(camera_T_object, model.points)
        facing = model.facing(camera_T_object)
        index = np.flatnonzero(facing)
        pixels = geometry.project(points[index], camera)
        inside = (pixels >= 0).all(axis=1) & (pixels[:, 0] <= camera.width - 1) & (pixels[:, 1] <= camera.height - 1)
        index, pixels = index[inside], pixels[inside]
        z = points[index, 2]
        offset = np.full(len(index), np.inf)
        base = np.floor(pixels).astype(np.int64)
        at = np.minimum(np.rint(pixels).astype(np.int64), [camera.width - 1, camera.height - 1])
        # The best of the four neighbours: at a depth edge, the nearest pixel may belong to another surface.
        for du, dv in ((0, 0), (1, 0), (0, 1), (1, 1)):
            u, v = np.minimum(base[:, 0] + du, camera.width - 1), np.minimum(base[:, 1] + dv, camera.height - 1)
            seen = depth[v, u]
            candidate = np.where(seen > 0, z - seen, np.inf)
            offset = np.where(np.abs(candidate) < np.abs(offset), candidate, offset)
        tolerance = self.tolerance(z)
        known = np.isfinite(offset)
        agrees = known & (np.abs(offset) <= tolerance)
        alike = self._is_alike(model, index, at[:, 1], at[:, 0])

        def spread(values: BoolMask) -> BoolMask:
            out = np.zeros(count, bool)
            out[index] = values
            return out

        return ModelFit(
            spread(np.ones(len(index), bool)),
            spread(agrees & alike),
            spread(known & (offset > tolerance)),
            spread(known & ((offset < -tolerance) | (agrees & ~alike))),
        )

    def register(self, model: SurfaceModel, camera_T_object: Float64Array) -> tuple[Float64Array, bool]:
        """The pose refined by point-to-plane registration of the model to the frame, with colour.

        Args:
            model: of the object.
            camera_T_object: (4, 4) initial pose, a few centimetres and degrees off at most.

        Returns:
            The registered pose, and whether it explains the frame better than the initial one; see `pose_costs`.
        """
        settings, source = self.settings, self._source(model, self._facing(model, camera_T_object))
        pose = refine(self.target, source, camera_T_object, settings=settings.registration).prev_T_curr
        return pose, self.is_better(model, camera_T_object, pose)

    def is_better(self, model: SurfaceModel, given: Float64Array, other: Float64Array) -> bool:
        """Whether a pose (4, 4) `camera_T_object` explains the frame better than a given one; see `pose_costs`."""
        return is_better(self.costs(model, (given, other)), self.settings.pose_cost)

    def costs(self, model: SurfaceModel, poses: Sequence[Float64Array]) -> Float64Array:
        """(K,) the cost of poses (4, 4) `camera_T_object`; see `pose_costs`.

        The points that face the camera at the first pose are compared.
        """
        settings, facing = self.settings, self._facing(model, poses[0])
        colors = Chroma(self.chroma, chroma(model.colors[facing]))
        source = self._source(model, facing)
        return pose_costs(self.target, source, poses, settings.registration, settings.pose_cost, colors)

    def mask(self, model: SurfaceModel, camera_T_object: Float64Array) -> tuple[BoolMask, Float32Array]:
        """Where the model is seen.

        Args:
            model: of the object.
            camera_T_object: (4, 4) its pose.

        Returns:
            (H, W) bool: the pixels at which the rendered model agrees with the frame in depth and colour, without
            small gaps; and (H, W) float32 the rendered depth, metres, infinite beside the object.
        """
        depth, index = model.render(camera_T_object, self.frame)
        inside = index >= 0
        measured = self.frame.frame.depth
        agrees = np.zeros(depth.shape, bool)
        rows, columns = np.nonzero(inside & (measured > 0))
        z = depth[rows, columns]
        near = np.abs(z - measured[rows, columns]) <= self.tolerance(z)
        alike = self._is_alike(model, index[rows, columns], rows, columns)
        agrees[rows, columns] = near & alike
        return np.asarray(
            _closed(agrees, self.settings.gap_radius)
            & inside
            & (measured > 0)
            & (agrees | _near(depth, measured, self.settings.gap_depth))
        ), depth

    def _is_alike(self, model: SurfaceModel, index: IndexArray, rows: IndexArray, columns: IndexArray) -> BoolMask:
        """(N,) bool: whether voxels of the model have the colours of these pixels."""
        apart = np.abs(chroma(model.colors[index]) - self.chroma[rows, columns]).max(axis=-1, initial=0)
        return np.asarray(apart <= self.settings.max_chroma)

    def _facing(self, model: SurfaceModel, camera_T_object: Float64Array) -> IndexArray:
        """Indices of the model's voxels that face the camera, sampled evenly."""
        facing = np.flatnonzero(model.facing(camera_T_object))
        if len(facing) > self.settings.registration_points:
            facing = facing[np.linspace(0, len(facing) - 1, self.settings.registration_points).astype(int)]
        return facing

    def _source(self, model: SurfaceModel, index: IndexArray) -> RegistrationSource:
        """These voxels of the model."""
        grays = model.grays()[index]
        return RegistrationSource(model.points[index].astype(np.float32), (grays, grays))


def chroma(color: Float64Array | np.ndarray) -> Float32Array:
    """The two colour-opponent channels of CIELAB, (..., 2) float32 around 0, of RGB colours (..., 3) in 0..255."""
    rgb = color if color.dtype == np.uint8 else np.clip(np.rint(color), 0, 255).astype(np.uint8)
    if not rgb.size:
        return np.zeros((*rgb.shape[:-1], 2), np.float32)
    # One row of pixels: OpenCV is slow on many short ones.
    lab = cv2.cvtColor(rgb.reshape(1, -1, 3), cv2.COLOR_RGB2LAB).reshape(*rgb.shape)
    return np.asarray(lab[..., 1:].astype(np.float32) - 128)


def _closed(mask: BoolMask, radius: int) -> BoolMask:
    kernel = np.ones((2 * radius + 1, 2 * radius + 1), np.uint8)
    return np.asarray(cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_CLOSE, kernel) > 0)


def _near(depth: Float32Array, measured: Float32Array, limit: float) -> BoolMask:
    """Pixels at which closing may fill a gap: the frame shows no surface in front of the model."""
    with np.errstate(invalid="ignore"):
        return np.asarray(depth - measured < limit)
