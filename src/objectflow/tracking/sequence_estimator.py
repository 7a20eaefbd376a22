"""A sequence, frame after frame: the motion of each pair, persistent ids, and the masks of all known objects."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from objectflow.alignment.frame_pair import FramePair
from objectflow.alignment.matching import DEFAULTS as MATCHING
from objectflow.alignment.prepared_frame import PreparedFrame
from objectflow.frame import RgbdFrame
from objectflow.methods.base import Estimator, estimate_pair
from objectflow.methods.labels import unknown_motion
from objectflow.motion import SceneMotion
from objectflow.tracking.known_objects import KnownObjects
from objectflow.tracking.known_settings import KnownSettings
from objectflow.tracking.model_motion import PairViews
from objectflow.tracking.running_noise import RunningNoise
from objectflow.tracking.scene_cut import CutSettings, is_cut
from objectflow.tracking.track import Track
from objectflow.tracking.tracker import Tracker
from objectflow.typing import LabelImage

CUT = "cut: the frames show different scenes, so no object is reported, and objects get new ids"
"""Note of an estimate that a cut replaces."""


@dataclass(frozen=True, eq=False)
class SequenceStep:
    """The result of one frame of a sequence.

    Attributes:
        prev, curr: the last frame and this one.
        times: of both, seconds, or frame numbers where there are no times.
        motion: between the frames; the camera is unknown at a cut to another scene, where a new world begins.
        tracks: track id of each object of `motion` that has a track, by the object's id.
        known: (H, W) int32 label image of every object that has moved up to now, by track id, also at rest and half
            hidden; 0 elsewhere.
        followed: track ids of the objects that moved although `motion` lacks them, as their models show.
    """

    prev: RgbdFrame
    curr: RgbdFrame
    times: tuple[float, float]
    motion: SceneMotion
    tracks: Mapping[int, int]
    known: LabelImage
    followed: tuple[int, ...] = ()


class SequenceEstimator:
    """Estimates consecutive frames, follows the objects and keeps those that have moved once known.

    With a limited history in the settings of the tracker, memory does not grow with time. `state` and `restore` stop
    and continue a sequence, also in another process.

    Attributes:
        cuts: when two frames show different scenes.
        tracker: the trajectories of the objects and of the camera.
        known_objects: the models of the objects.
        noise: the running estimate of the camera's depth noise, with which models are compared with frames.
        segmentation: the label image `known` of the latest step; None before the first.
    """

    def __init__(
        self,
        estimator: Estimator,
        *,
        tracker: Tracker | None = None,
        settings: KnownSettings | None = None,
        cuts: CutSettings | None = None,
    ) -> None:
        """Prepare a sequence.

        Args:
            estimator: of the pairs.
            tracker: a new one, for settings other than the default.
            settings: of the known objects.
            cuts: when two frames show different scenes.
        """
        self.estimator = estimator
        self.cuts = cuts or CutSettings()
        self.tracker = tracker or Tracker()
        self.known_objects = KnownObjects(settings)
        self.noise = RunningNoise(self.known_objects.settings.noise_pairs, self.known_objects.settings.noise)
        self.segmentation: LabelImage | None = None
        self._last: PreparedFrame | None = None
        self._time = 0.0

    @property
    def tracks(self) -> list[Track]:
        """All tracks that are kept, in order of id."""
        return self.tracker.tracks

    def update(
        self, frame: RgbdFrame, time: float | None = None, motion: SceneMotion | None = None
    ) -> SequenceStep | None:
        """Add the next frame.

        Args:
            frame: of the same size and camera as the last one.
            time: of the frame, later than that of the last one; the frame's time stamp if None, or the number of the
                frame where it has none.
            motion: between the last frame and this one, where it is known already, as from an earlier run; None
                estimates it.

        Returns:
            The result, or None for the first frame of a sequence.

        Raises:
            FrameError: the frames differ in size or intrinsics, or their times do not rise.
        """
        if time is None:
            time = frame.timestamp
        if time is None:
            time = 0.0 if self._last is None else self._time + 1
        prev, prev_time = self._last, self._time
        if prev is None:
            self._last, self._time = PreparedFrame.of(frame), time
            return None
        # What the last estimate computed on its current frame is not computed again, nor are this estimate's matches.
        pair = FramePair(prev, frame, matching=getattr(self.estimator, "matching", MATCHING))
        found = estimate_pair(self.estimator, pair) if motion is None else motion
        if is_cut(pair, found, self.cuts):
            unknown = unknown_motion(found.labels.shape)
            found = replace(unknown, method=found.method, seconds=found.seconds, settings=found.settings, notes=(CUT,))
        view = self.known_objects.view(pair.curr, self.noise.add(pair, found))
        static = np.eye(4) if found.camera_motion is None else found.camera_motion
        evidence = self.known_objects.evidence(view, found.labels, static, self.tracker)
        tracks = self.tracker.update(
            prev_time,
            frame,
            time,
            found,
            evidence,
        )
        views = PairViews(pair, self.known_objects.view(pair.prev, view.noise), view, static, self.segmentation)
        followed = self.known_objects.follow(views, found, tracks, self.tracker, prev_time, time)
        known = self.known_objects.update(view, found, tracks, self.tracker, frame.depth.shape, followed)
        self._last, self._time, self.segmentation = pair.curr, time, known
        return SequenceStep(prev.frame, frame, (prev_time, time), found, tracks, known, followed)

    def cut(self) -> None:
        """Start a new world, as after a cut: the next frame is a first one, and objects get new ids.

        The noise of the camera is kept.
        """
        self.tracker.reset()
        self.known_objects.objects = {}
        self._last = self.segmentation = None

    def state(self) -> dict[str, Any]:
        """Everything that later results depend on but the estimator; it can be pickled."""
        last = None if self._last is None else self._last.frame
        return {
            "tracker": self.tracker,
            "known_objects": self.known_objects,
            "noise": self.noise,
            "last": last,
            "time": self._time,
            "segmentation": self.segmentation,
        }

    def restore(self, state: Mapping[str, Any]) -> None:
        """Continue from a `state`; the estimator must be the same."""
        self.tracker, self.known_objects = state["tracker"], state["known_objects"]
        self.noise = state["noise"]
        self._last = None if state["last"] is None else PreparedFrame(state["last"])
        self._time, self.segmentation = state["time"], state["segmentation"]
