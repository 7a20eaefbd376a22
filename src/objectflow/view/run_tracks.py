"""Tracks of a run's objects while it is computed, and their marks in its overlays."""

from __future__ import annotations

import itertools
import statistics
from collections.abc import Sequence

import numpy as np

from objectflow import geometry
from objectflow.frame import RgbdFrame
from objectflow.motion import SceneMotion
from objectflow.readers import FrameSource
from objectflow.tracking.tracker import Tracker
from objectflow.view.overlay import TrackMarks

TRAIL = 30
"""Number of earlier positions that a trail shows."""
FRAME_RATE = 5.0
"""Pairs per second of a video where the source has no times."""
MAX_FRAME_RATE = 30.0


class RunTracks:
    """Links the objects of a run's pairs in their order.

    Attributes:
        tracker: holds the trajectories.
        frame_rate: pairs per second of the source, at most `MAX_FRAME_RATE`.
    """

    def __init__(self, source: FrameSource, parts: Sequence[Sequence[int]]) -> None:
        """Prepare the tracks of a run.

        Args:
            source: of the frames.
            parts: the selected frame numbers of each part without a cut.
        """
        self.tracker = Tracker()
        times = {index: source.timestamp(index) for part in parts for index in part}
        # Frame numbers serve as times where the source has none.
        known = {index: time for index, time in times.items() if time is not None}
        self._times = known if len(known) == len(times) else {index: float(index) for index in times}
        gaps = [known[b] - known[a] for part in parts for a, b in itertools.pairwise(part) if len(known) == len(times)]
        self.frame_rate = FRAME_RATE
        if gaps:
            self.frame_rate = min(MAX_FRAME_RATE, 1 / max(statistics.median(gaps), 1e-3))
        self._last: int | None = None

    def add(self, prev_index: int, curr_index: int, curr: RgbdFrame, motion: SceneMotion) -> TrackMarks:
        """Link the next pair's objects and return their marks.

        Args:
            prev_index, curr_index: frame numbers; a pair that does not follow the last one starts anew.
            curr: the current frame.
            motion: between the frames.
        """
        if self._last is not None and prev_index != self._last:
            self.tracker.reset()
        self._last = curr_index
        ids = self.tracker.update(self._times[prev_index], curr, self._times[curr_index], motion)
        if not self.tracker.world_T_camera:  # the camera is lost
            return TrackMarks(ids, {})
        curr_T_world = geometry.inverse(self.tracker.world_T_camera[-1])
        trails = {}
        for track in self.tracker.tracks:
            if track.id in ids.values():
                positions = np.array([pose[:3, 3] for pose in track.world_T_object[-TRAIL:]])
                trails[track.id] = geometry.transform(curr_T_world, positions)
        return TrackMarks(ids, trails)
