"""Compensation of the camera's motion, for methods that assume a static camera.

The background's motion is estimated first. The previous frame is rendered as the current camera would have seen it,
the method is given two frames of one static camera, and its motions are composed with that of the camera.
"""

from __future__ import annotations

import dataclasses
import time
from abc import abstractmethod
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import cv2
import numpy as np
from scipy import ndimage

from objectflow import geometry
from objectflow.alignment import warping
from objectflow.alignment.camera_estimate import CameraCheckSettings, CameraEstimate, estimate_camera
from objectflow.alignment.camera_motion import CameraMotionSettings
from objectflow.alignment.frame_pair import FramePair
from objectflow.alignment.matching import MatchSettings
from objectflow.errors import MethodError
from objectflow.frame import RgbdFrame
from objectflow.geometry.camera import Camera
from objectflow.geometry.depth_noise import STRUCTURED_LIGHT, DepthNoise, DepthNoiseName
from objectflow.geometry.moved import STATIC_DISPLACEMENT, displaces
from objectflow.methods.base import Estimator, PairEstimator, closer, estimate_pair
from objectflow.methods.labels import unknown_motion, with_surface_centers
from objectflow.motion import ObjectMotion, SceneMotion
from objectflow.runtime.side_threads import has_side_threads
from objectflow.runtime.threads import one_blas_thread
from objectflow.settings import Settings, setting
from objectflow.typing import Float32Array, Float64Array

SCALE_ERROR = 0.1
"""Default of `CompensationConfig.scale_error`."""
VIEW_TOLERANCE = 0.02
"""Default of `CompensationConfig.view_tolerance`."""
CRACK_DEPTH = 0.05
"""Default of `CompensationConfig.crack_depth`."""


@dataclass(frozen=True)
class CompensationConfig(Settings):
    """The settings of methods that assume a static camera."""

    camera: Literal["auto", "static", "moving"] = "auto"
    """static: the camera stood still. moving: its motion is always compensated. auto: it is compensated where the
    background's motion exceeds the noise."""
    seed: int = setting(0, minimum=0)
    """Seed of the random minimal sets of the camera's motion."""
    depth_noise: DepthNoiseName = "measured"
    """Noise model of the depth camera; measured: fitted to each pair."""
    scale_error: float = setting(SCALE_ERROR, minimum=0)
    """Error of an object's own motion relative to how far the camera moved past it: depth cameras are off in scale by
    a few percent, and so is the estimated motion of the camera."""
    view_tolerance: float = setting(VIEW_TOLERANCE, minimum=0)
    """Largest difference of depth, relative to depth and beside its noise, between the previous frame as the current
    camera would have seen it and the previous image that it is sampled from."""
    crack_depth: float = setting(CRACK_DEPTH, minimum=0, maximum=1)
    """Smallest difference of depth, relative to depth, at which a farther surface between two pixels of a nearer one
    is a crack of the rendered view, which is closed."""
    error_factor: float = setting(2.0, minimum=0)
    """Factor on the median distance of matches from the camera's motion; objects that move by less are static."""
    matching: MatchSettings = MatchSettings()
    camera_motion: CameraMotionSettings = CameraMotionSettings()
    camera_check: CameraCheckSettings = CameraCheckSettings()


class _Compensated(NamedTuple):
    """A pair before a static camera, None where nothing can be estimated; and what is known of the camera."""

    pair: FramePair | None
    camera: CameraEstimate


@dataclass(frozen=True)
class StaticCameraEstimator(CompensationConfig, PairEstimator):
    """Base of methods that assume a static camera: makes them work before a moving one."""

    @abstractmethod
    def estimate_static(self, pairs: Sequence[FramePair]) -> list[SceneMotion]:
        """The motions of pairs from a static camera."""

    def estimate(self, pair: FramePair) -> SceneMotion:
        """See `PairEstimator`. `camera_motion` of the result is set where the camera was found to move."""
        return self.estimate_batch([pair])[0]

    @one_blas_thread()
    def estimate_batch(self, pairs: Iterable[FramePair]) -> list[SceneMotion]:
        """Estimate several pairs; their seconds are shared equally.

        Args:
            pairs: frames of any size; those of one size are evaluated together.
        """
        start = time.perf_counter()
        pairs = list(pairs)
        if len(pairs) == 1 and has_side_threads():
            self.start(pairs[0])
        ready = [self._compensate(pair) for pair in pairs]
        static = iter(self.estimate_static([one.pair for one in ready if one.pair is not None]))
        motions = []
        for pair, (seen, camera) in zip(pairs, ready, strict=True):
            if camera.state == "unknown":
                motion = unknown_motion(pair.curr.frame.depth.shape)
            elif seen is None:
                motion = _camera_alone(pair, camera.prev_T_curr)
            elif camera.prev_T_curr is None:
                motion = next(static)
            else:
                tolerance = max(STATIC_DISPLACEMENT, self.error_factor * camera.error)
                motion = compose(
                    next(static), pair.curr.points, camera.prev_T_curr, self.scale_error, tolerance=tolerance
                )
            motions.append(dataclasses.replace(motion, notes=camera.notes, method=motion.method or self._name))
        seconds = (time.perf_counter() - start) / max(1, len(pairs))
        return [
            dataclasses.replace(
                motion,
                objects=with_surface_centers(motion.labels, motion.objects, pair.curr.points),
                seconds=seconds,
                settings=self.to_dict(),
            )
            for pair, motion in zip(pairs, motions, strict=True)
        ]

    @property
    def _name(self) -> str:
        """The method's name, for results that no method made."""
        return str(getattr(self, "METHOD", ""))

    def _compensate(self, pair: FramePair) -> _Compensated:
        """The pair as a static camera would have seen it, in one light and with the noise of its depth."""
        camera = estimate_camera(
            pair.with_matching(self.matching),
            camera=self.camera,
            depth_noise=self.depth_noise,
            seed=self.seed,
            motion=self.camera_motion,
            settings=self.camera_check,
        )
        if camera.state == "unknown":
            return _Compensated(None, camera)
        pair = camera.pair
        if camera.prev_T_curr is None:
            return _Compensated(pair, camera)
        seen = as_seen_from(
            pair.prev.frame,
            camera.prev_T_curr,
            pair.curr.frame.camera,
            pair.noise,
            self.view_tolerance,
            self.crack_depth,
        )
        if seen is None:
            return _Compensated(None, camera)
        return _Compensated(pair.with_previous(seen, geometry.inverse(camera.prev_T_curr)), camera)


@dataclass(frozen=True)
class MovingCamera(StaticCameraEstimator):
    """Any estimator that assumes a static camera, made to work before a moving one."""

    estimator: Estimator | None = None
    """It is called with frames from one camera pose."""

    @property
    def weights(self) -> Path | None:
        """The file of the estimator's weights, if it has any."""
        found: Path | None = getattr(self.estimator, "weights", None)
        return found

    def closer(self) -> MovingCamera:
        """See `PairEstimator`."""
        return self if self.estimator is None else dataclasses.replace(self, estimator=closer(self.estimator))

    def estimate_static(self, pairs: Sequence[FramePair]) -> list[SceneMotion]:
        """See `StaticCameraEstimator`."""
        estimator = self.estimator
        if estimator is None:
            raise MethodError("MovingCamera needs an estimator: MovingCamera(estimator=...)")
        return [estimate_pair(estimator, pair) for pair in pairs]

    def to_dict(self) -> dict[str, Any]:
        """The settings of the compensation and, where it has any, those of the estimator."""
        inner: dict[str, Any] = self.estimator.to_dict() if isinstance(self.estimator, Settings) else {}
        own = {name: value for name, value in super().to_dict().items() if name != "estimator"}
        return {**inner, **own}


def _camera_alone(pair: FramePair, prev_T_curr: Float64Array | None) -> SceneMotion:
    """The result where nothing of the previous frame is in view: the camera's motion and no objects."""
    points = pair.curr.points
    labels = np.zeros(points.shape[:2], np.int32)
    return SceneMotion(labels, geometry.flow_from_motions(points, labels, {}, prev_T_curr), camera_motion=prev_T_curr)


def as_seen_from(
    prev: RgbdFrame,
    prev_T_curr: Float64Array,
    camera: Camera,
    noise: DepthNoise = STRUCTURED_LIGHT,
    view_tolerance: float = VIEW_TOLERANCE,
    crack_depth: float = CRACK_DEPTH,
) -> RgbdFrame | None:
    """The previous frame rendered from the pose of the current camera.

    Points are splatted into the view and cracks between them closed; colour and depth are then sampled from the
    previous image at each pixel's point, so that neither is coarser than the original. Pixels that the previous camera
    did not see have no depth and the colour of the nearest surface.

    Args:
        prev: the previous frame.
        prev_T_curr: the camera's motion, as the background's.
        camera: of the current frame.
        noise: of the depth.
        view_tolerance, crack_depth: see `CompensationConfig`.

    Returns:
        A frame on `camera`'s pixels, or None if no point lies in its view.
    """
    curr_T_prev = geometry.inverse(prev_T_curr)
    points = geometry.transform(curr_T_prev, geometry.back_project(prev.depth, prev.camera))
    color, thrown = warping.splat(points, prev.color, camera)
    if not (thrown > 0).any():
        return None
    closed = _close_cracks(thrown, crack_depth)
    in_prev = geometry.transform(prev_T_curr, geometry.back_project(closed, camera))
    tolerance = 3 * noise.sigma(closed) + view_tolerance * closed + 1e-6
    sampled = warping.warp_previous(prev, in_prev, tolerance=tolerance)
    # Along the ray of `in_prev`, at the depth that the previous camera measured there.
    with np.errstate(invalid="ignore", divide="ignore"):
        measured = in_prev * (sampled.depth / in_prev[..., 2])[..., None]
    exact = geometry.transform(curr_T_prev, measured)[..., 2]
    depth = np.where(sampled.visible & (exact > 0), exact, thrown).astype(np.float32)
    color = np.where(sampled.visible[..., None], np.rint(sampled.color), color).astype(np.uint8)
    empty = depth <= 0
    rows, columns = ndimage.distance_transform_edt(empty, return_distances=False, return_indices=True)
    return RgbdFrame(color=color[rows, columns], depth=depth, camera=camera, timestamp=prev.timestamp, name=prev.name)


def _close_cracks(depth: Float32Array, crack_depth: float) -> Float32Array:
    """Depth with gaps of one or two pixels between points of one surface filled from their rims."""
    nearness = np.where(depth > 0, 1 / np.maximum(depth, 1e-6), 0).astype(np.float32)
    closed = cv2.morphologyEx(nearness, cv2.MORPH_CLOSE, np.ones((3, 3)))
    # Cracks through which a farther surface is visible are closed too; they would take its colour.
    crack = (closed > 0) & (nearness < (1 - crack_depth) * closed)
    return np.where(crack, 1 / np.maximum(closed, 1e-6), depth).astype(np.float32)


def compose(
    static: SceneMotion,
    points: Float32Array,
    prev_T_curr: Float64Array,
    scale_error: float = SCALE_ERROR,
    *,
    tolerance: float = STATIC_DISPLACEMENT,
) -> SceneMotion:
    """Compose motions before a static camera with the motion of the camera.

    Objects that moved by less than the error of the camera's motion count as static.

    Args:
        static: motions from the current frame to the previous one as the current camera would have seen it.
        points: (H, W, 3) metres of the current frame.
        prev_T_curr: the camera's motion.
        scale_error: see `CompensationConfig`.
        tolerance: metres: objects that move by less are static.

    Returns:
        Motions from the current frame to the previous camera; the background moves with the camera.
    """
    flow = geometry.transform(prev_T_curr, points + static.scene_flow) - points
    objects = tuple(
        dataclasses.replace(
            obj,
            prev_T_curr=prev_T_curr @ obj.prev_T_curr,
            moving=obj.moving
            and _exceeds_camera_error(obj, points[static.labels == obj.id], prev_T_curr, scale_error, tolerance),
        )
        for obj in static.objects
    )
    return dataclasses.replace(
        static, scene_flow=flow.astype(np.float32), objects=objects, camera_motion=np.asarray(prev_T_curr)
    )


def _exceeds_camera_error(
    obj: ObjectMotion, points: Float32Array, prev_T_curr: Float64Array, scale_error: float, tolerance: float
) -> bool:
    """Whether an object's own motion exceeds the error of the camera's, at its centre or at the end of its points."""
    passed = float(np.linalg.norm(geometry.transform(prev_T_curr, obj.center) - obj.center))
    tolerance = max(tolerance, scale_error * passed)
    return displaces(obj.prev_T_curr, points[np.isfinite(points[:, 2])], obj.center, tolerance)
