"""Tracks of a run's objects while it is computed, and their marks in its overlays."""

from __future__ import annotations

import itertools
import statistics
from collections import deque
from collections.abc import Sequence

import numpy as np

from objectflow import geometry
from objectflow.frame import RgbdFrame
from objectflow.methods.base import Estimator
from objectflow.motion import SceneMotion
from objectflow.readers import FrameSource
from objectflow.tracking.longer_gap import LongerEstimate
from objectflow.tracking.sequence_estimator import SequenceEstimator, SequenceStep
from objectflow.typing import LabelImage
from objectflow.view.overlay import TrackMarks
from objectflow.view.viewer_frames import ViewerFrame, tracked_frames

TRAIL = 30
"""Number of positions that a trail shows: those of the present centre of the surface."""
FRAME_RATE = 5.0
"""Pairs per second of a video where the source has no times."""
MAX_FRAME_RATE = 30.0


class RunTracks:
    """Estimates a run's pairs in their order, and links their objects.

    Attributes:
        sequence: holds the trajectories and the known objects.
        frame_rate: pairs per second of the source, at most `MAX_FRAME_RATE`.
    """

    def __init__(self, source: FrameSource, parts: Sequence[Sequence[int]], estimator: Estimator) -> None:
        """Prepare the tracks of a run.

        Args:
            source: of the frames.
            parts: the selected frame numbers of each part without a cut.
            estimator: of the pairs.
        """
        self.sequence = SequenceEstimator(estimator)
        self._source = source
        times = {index: source.timestamp(index) for part in parts for index in part}
        # Frame numbers serve as times where the source has none.
        known = {index: time for index, time in times.items() if time is not None}
        self._times = known if len(known) == len(times) else {index: float(index) for index in times}
        self._indices: dict[float, int] = {}
        gaps = [known[b] - known[a] for part in parts for a, b in itertools.pairwise(part) if len(known) == len(times)]
        self.frame_rate = FRAME_RATE
        if gaps:
            self.frame_rate = min(MAX_FRAME_RATE, 1 / max(statistics.median(gaps), 1e-3))
        self._start = min(known.values(), default=0.0)
        self._last: int | None = None
        self._recent = deque[int](maxlen=self.sequence.known_objects.settings.earlier.frames)
        self._revised: dict[int, LabelImage] = {}

    def add(
        self,
        prev_index: int,
        curr_index: int,
        curr: RgbdFrame,
        motion: SceneMotion | None = None,
        longer: tuple[int, SceneMotion] | None = None,
    ) -> tuple[SequenceStep, TrackMarks]:
        """Estimate the next pair, link its objects, and return the step and the objects' marks.

        Args:
            prev_index, curr_index: frame numbers; a pair that does not follow the last one starts anew.
            curr: the current frame.
            motion: between the frames, where an earlier run has estimated it.
            longer: an older frame and the motion between it and `curr`, where an earlier run has estimated it.
        """
        if prev_index != self._last:
            self.sequence.cut()
            self._indices = {self._times[prev_index]: prev_index}  # times may repeat after a cut
            self.sequence.update(self._source[prev_index], self._times[prev_index])
        self._last = curr_index
        self._recent.append(curr_index)
        self._indices[self._times[curr_index]] = curr_index
        given = None if longer is None else LongerEstimate(self._times[longer[0]], longer[1])
        step = self.sequence.update(curr, self._times[curr_index], motion, given)
        if step is None:
            raise RuntimeError("the previous frame is missing")
        self._revised |= {self._indices[time]: known for time, known in step.revised.items()}
        tracker = self.sequence.tracker
        if not tracker.world_T_camera:  # the camera is lost
            return step, TrackMarks(step.tracks, {})
        world_T_curr = tracker.world_T_camera[-1]
        centers = {step.tracks[obj.id]: obj.center for obj in step.motion.objects if obj.id in step.tracks}
        trails = {}
        for track in tracker.tracks:
            if track.id in centers:
                # The point that is the centre of the surface now, so that the trail ends at the arrow.
                center = geometry.transform(
                    geometry.inverse(track.world_T_object[-1]) @ world_T_curr, centers[track.id]
                )
                positions = np.array([geometry.transform(pose, center) for pose in track.world_T_object[-TRAIL:]])
                trails[track.id] = geometry.transform(geometry.inverse(world_T_curr), positions)
        return step, TrackMarks(step.tracks, trails)

    def final_masks(self, is_last: bool = False) -> list[tuple[int, LabelImage]]:
        """The masks of known objects that differ from those in the step of their frame, once they are final.

        Objects that are found in one of the next frames are added to a frame. Each mask is returned once.

        Args:
            is_last: whether no step follows.

        Returns:
            Frame numbers and (H, W) int32 masks by track id.
        """
        open_frames = {index for index in self._recent if not is_last}
        final = [index for index in self._revised if index not in open_frames]
        return [(index, self._revised.pop(index)) for index in final]

    def index_at(self, time: float) -> int:
        """The frame number at a time since the last cut."""
        return self._indices[time]

    def frames(self, step: SequenceStep, prev_index: int, curr_index: int) -> tuple[ViewerFrame, ViewerFrame]:
        """Both frames of the step that `add` has returned last, for a viewer."""
        times = (self._source.timestamp(index) for index in (prev_index, curr_index))
        prev, curr = (None if time is None else time - self._start for time in times)
        frames, numbers = (step.prev, step.curr), (prev_index, curr_index)
        return tracked_frames(
            self.sequence.tracker, step.tracks, frames, step.motion, numbers, (prev, curr), step.known
        )
