"""A moving camera for methods that are made for a still one.

The background's motion is estimated first; the previous frame is rendered as the current camera would have seen it,
the method is given two frames of one static camera, and its motions are carried back to where the camera really was.
"""

from __future__ import annotations

import dataclasses
import time
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from scipy import ndimage

from objectflow import geometry
from objectflow.alignment import warping
from objectflow.alignment.camera_motion import background_motion
from objectflow.alignment.frame_pair import FramePair
from objectflow.alignment.moved import STATIC_DISPLACEMENT, is_moving
from objectflow.frame import RgbdFrame, check_pair
from objectflow.geometry.camera import Camera
from objectflow.geometry.depth_noise import depth_sigma
from objectflow.methods.base import AcceptsFramePair, Estimator, check_camera_option
from objectflow.motion import ObjectMotion, SceneMotion
from objectflow.typing import Float32Array, Float64Array

SCALE_ERROR = 0.1
"""Of the way that the camera went past an object: a depth camera's scale is off by some percent, and what that makes
of the camera's own motion is no object's motion."""


@dataclass(frozen=True)
class MovingCamera:
    """An estimator for a still camera, made fit for a moving one.

    Attributes:
        estimator: the method; it is called with frames of one camera pose.
        camera: "static" calls the method as it is, "moving" always compensates, "auto" only if the background's
            motion stands out from the noise.
        seed: of the random minimal sets.
    """

    estimator: Estimator
    camera: str = "auto"
    seed: int = 0

    def __post_init__(self) -> None:
        check_camera_option(self.camera)

    @property
    def weights(self) -> Path | None:
        """The file of the method's weights, if it has some."""
        found: Path | None = getattr(self.estimator, "weights", None)
        return found

    def __call__(self, prev: RgbdFrame, curr: RgbdFrame) -> SceneMotion:
        """See `Estimator`. `camera_motion` is set where the camera was found to move."""
        start = time.perf_counter()
        check_pair(prev, curr)
        pair = FramePair(prev, curr)
        prev_T_curr = find_camera_motion(pair, camera=self.camera, seed=self.seed)
        if prev_T_curr is None:
            still = _call(self.estimator, prev, curr, pair)
            return dataclasses.replace(still, seconds=time.perf_counter() - start)
        seen = as_seen_from(prev, prev_T_curr, curr.camera)
        if seen is None:
            # Nothing of the previous frame lies in the current view: all that can be told is how the camera moved.
            points = geometry.back_project(curr.depth, curr.camera)
            labels = np.zeros(curr.depth.shape, np.int32)
            flow = geometry.flow_from_motions(points, labels, {}, prev_T_curr)
            still = SceneMotion(labels, flow, camera_motion=prev_T_curr)
        else:
            still = compose(self.estimator(seen, curr), curr, prev_T_curr)
        return dataclasses.replace(still, seconds=time.perf_counter() - start)


def _call(estimator: Estimator, prev: RgbdFrame, curr: RgbdFrame, pair: FramePair) -> SceneMotion:
    """The estimator's answer, sooner where it can use what is ready."""
    return estimator.estimate(prev, curr, pair) if isinstance(estimator, AcceptsFramePair) else estimator(prev, curr)


def find_camera_motion(pair: FramePair, *, camera: str = "auto", seed: int = 0) -> Float64Array | None:
    """`prev_T_curr` of the static background.

    Args:
        pair: the frames.
        camera: "moving" always answers, "auto" answers None unless the motion stands out, "static" is None.
        seed: of the random minimal sets.
    """
    if camera == "static":
        return None
    rng = np.random.default_rng(seed)
    return background_motion(pair.matches, pair.target, pair.curr_small, camera=camera, rng=rng)


def as_seen_from(prev: RgbdFrame, prev_T_curr: Float64Array, camera: Camera) -> RgbdFrame | None:
    """The previous frame rendered from the current camera's place.

    Points are thrown into the view, cracks between them closed, and colour and depth then read from the previous image
    where each pixel's point lies in it, so that neither is coarser than the original. What the previous camera did not
    see stays without depth; its colour is that of the nearest surface.

    Args:
        prev: the previous frame.
        prev_T_curr: the camera's motion, as the background's.
        camera: of the current frame.

    Returns:
        A frame on `camera`'s pixels, or None if no point falls into its view.
    """
    curr_T_prev = geometry.inverse(prev_T_curr)
    points = geometry.transform(curr_T_prev, geometry.back_project(prev.depth, prev.camera))
    color, thrown = warping.splat(points, prev.color, camera)
    if not (thrown > 0).any():
        return None
    closed = _close_cracks(thrown)
    in_prev = geometry.transform(prev_T_curr, geometry.back_project(closed, camera))
    tolerance = 3 * depth_sigma(closed) + 0.02 * closed + 1e-6
    sampled = warping.warp_previous(prev, in_prev, tolerance=tolerance)
    # Along the ray of `in_prev`, to the depth that the previous camera measured there.
    with np.errstate(invalid="ignore", divide="ignore"):
        measured = in_prev * (sampled.depth / in_prev[..., 2])[..., None]
    exact = geometry.transform(curr_T_prev, measured)[..., 2]
    depth = np.where(sampled.visible & (exact > 0), exact, thrown).astype(np.float32)
    color = np.where(sampled.visible[..., None], np.rint(sampled.color), color).astype(np.uint8)
    empty = depth <= 0
    rows, columns = ndimage.distance_transform_edt(empty, return_distances=False, return_indices=True)
    return RgbdFrame(color=color[rows, columns], depth=depth, camera=camera, timestamp=prev.timestamp, name=prev.name)


def _close_cracks(depth: Float32Array) -> Float32Array:
    """Depth with gaps of a pixel or two, between points of one surface, filled from their rims."""
    nearness = np.where(depth > 0, 1 / np.maximum(depth, 1e-6), 0).astype(np.float32)
    closed = cv2.morphologyEx(nearness, cv2.MORPH_CLOSE, np.ones((3, 3)))
    # Also where a farther surface shines through a crack: it would take its colour there.
    crack = (closed > 0) & (nearness < 0.95 * closed)
    return np.where(crack, 1 / np.maximum(closed, 1e-6), depth).astype(np.float32)


def compose(still: SceneMotion, curr: RgbdFrame, prev_T_curr: Float64Array) -> SceneMotion:
    """Carry motions between two frames of one camera pose back to the camera that moved.

    What moved less than the camera's own way may feign is no longer said to move.

    Args:
        still: motions from `curr` to the previous moment, as the current camera would have seen it.
        curr: the current frame.
        prev_T_curr: the camera's motion.

    Returns:
        Motions from `curr` to the previous camera; the background moves with the camera.
    """
    points = geometry.back_project(curr.depth, curr.camera)
    flow = geometry.transform(prev_T_curr, points + still.scene_flow) - points
    objects = tuple(
        dataclasses.replace(
            obj,
            prev_T_curr=prev_T_curr @ obj.prev_T_curr,
            moving=obj.moving and _exceeds_camera_error(obj, prev_T_curr),
        )
        for obj in still.objects
    )
    return dataclasses.replace(
        still, scene_flow=flow.astype(np.float32), objects=objects, camera_motion=np.asarray(prev_T_curr)
    )


def _exceeds_camera_error(obj: ObjectMotion, prev_T_curr: Float64Array) -> bool:
    """Whether an object's own motion is more than the error of the camera's."""
    passed = np.linalg.norm(geometry.transform(prev_T_curr, obj.center) - obj.center)
    return bool(
        is_moving(obj.prev_T_curr[:3, :3], obj.translation, max(STATIC_DISPLACEMENT, SCALE_ERROR * float(passed)))
    )
