"""`Track`: everything that is known of one object of a sequence."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from objectflow import geometry
from objectflow.alignment.prepared_frame import PreparedFrame
from objectflow.frame import RgbdFrame
from objectflow.geometry.depth_noise import STRUCTURED_LIGHT, DepthNoise
from objectflow.geometry.resample import resize_nearest
from objectflow.motion import SceneMotion
from objectflow.tracking.bounding_box import OrientedBox, smallest_box
from objectflow.tracking.known_settings import KnownSettings
from objectflow.tracking.model_fit import FrameView
from objectflow.tracking.surface_model import SurfaceModel
from objectflow.typing import Float32Array, Float64Array


@dataclass(eq=False)
class Track:
    """The trajectory of one object and its shape. It can be pickled. The world frame is the camera of the first frame.

    Attributes:
        id: from 1, never reused.
        times: of each pose, in seconds, or frame numbers where there are no times.
        world_T_object: (4, 4) at each time. The object frame starts at the object's centre, aligned with the world.
        labels: the object's id in the result of each time; 0 where the pose is that of a pair's previous frame, and
            where only the model shows the step.
        scores: of each pose.
        gaps: times at which the object was seen to move, but with a score too low for a pose. A track that begins with
            one has its first pose then: where the object came from is not known.
        model: the accumulated surface in the object frame, which a `SequenceEstimator` fuses; otherwise None.
        world_T_camera: (4, 4) the camera in the latest frame of the track's world.
        merged: ids of tracks that ended because their objects are pieces of this one.
    """

    id: int
    times: list[float] = field(default_factory=list)
    world_T_object: list[Float64Array] = field(default_factory=list)
    labels: list[int] = field(default_factory=list)
    scores: list[float] = field(default_factory=list)
    gaps: list[float] = field(default_factory=list)
    model: SurfaceModel | None = None
    world_T_camera: Float64Array = field(default_factory=lambda: np.eye(4))
    merged: list[int] = field(default_factory=list)

    @property
    def confidence(self) -> float:
        """Mean score of the steps in which the object was seen to move, 0..1; a gap counts as 0."""
        seen = [score for label, score in zip(self.labels, self.scores, strict=True) if label]
        return float(sum(seen) / max(1, len(seen) + len(self.gaps)))

    def prepend(self, times: Sequence[float], world_T_object: Sequence[Float64Array], scores: Sequence[float]) -> None:
        """Add poses before the first one, which only the model shows.

        Args:
            times: rising, before the first time of the track.
            world_T_object: (4, 4) at each time.
            scores: of each pose.
        """
        self.times[:0] = times
        self.world_T_object[:0] = world_T_object
        self.labels[:0] = [0] * len(times)
        self.scores[:0] = scores

    def rest_until(self, time: float) -> None:
        """Add the last pose again at a later time, until which the object is assumed to have rested."""
        if self.times[-1] < time:
            self.times.append(time)
            self.world_T_object.append(self.world_T_object[-1])
            self.labels.append(0)
            self.scores.append(self.scores[-1])

    def keep_last(self, count: int) -> None:
        """Delete all but the last poses."""
        del self.times[:-count], self.world_T_object[:-count], self.labels[:-count], self.scores[:-count]
        self.gaps = [time for time in self.gaps if time >= self.times[0]]

    def points(
        self,
        frame: RgbdFrame,
        world_T_camera: Float64Array | None = None,
        *,
        settings: KnownSettings | None = None,
        noise: DepthNoise = STRUCTURED_LIGHT,
    ) -> Float32Array:
        """The surface of the object that a frame shows, as a grasp needs it: without what hides it.

        Args:
            frame: colour and depth, with the object at its latest pose.
            world_T_camera: (4, 4) the frame's camera; None for that of the latest frame.
            settings: of the comparison between the model and the frame.
            noise: of the frame's depth.

        Returns:
            (N, 3) metres in the camera frame: the measured points of the pixels at which the model agrees with the
            frame. Empty where the object is not seen, and without a model.
        """
        if self.model is None or not self.world_T_object:
            return np.zeros((0, 3), np.float32)
        view = FrameView(PreparedFrame(frame), settings or KnownSettings(), noise)
        camera = self.world_T_camera if world_T_camera is None else world_T_camera
        mask, _ = view.mask(self.model, geometry.inverse(camera) @ self.world_T_object[-1])
        mask = resize_nearest(mask.astype(np.uint8), frame.depth.shape) > 0
        return np.asarray(geometry.back_project(frame.depth, frame.camera)[mask & frame.valid])

    def bounding_box(self) -> OrientedBox | None:
        """The smallest box around the model, in the object frame; None without a model.

        It bounds the surface that was seen. `world_T_object[-1] @ object_T_box` is its latest pose in the world.
        """
        return None if self.model is None else smallest_box(self.model.points)


def next_camera_pose(world_T_prev: Float64Array, motion: SceneMotion) -> Float64Array | None:
    """The camera's pose in the current frame of a pair.

    Args:
        world_T_prev: (4, 4) pose in the previous frame.
        motion: the estimate for the pair.

    Returns:
        (4, 4), or None where the camera is lost: poses cannot be continued, and the next frame starts a new world.
    """
    if not motion.camera_known:
        return None
    return world_T_prev.copy() if motion.camera_motion is None else world_T_prev @ motion.camera_motion
