"""The results of a run as viewer frames, with the track ids of `tracks.json`."""

from __future__ import annotations

from pathlib import Path

from objectflow.errors import ResultError
from objectflow.frame import RgbdFrame
from objectflow.motion import SceneMotion
from objectflow.readers import FrameSource
from objectflow.tracking.tracker import Tracker
from objectflow.view.viewer_frames import ViewerFrame, check_size, tracked_frames


class RunFrames:
    """Reads the results of a run pair by pair and tracks their objects."""

    def __init__(self, source: FrameSource) -> None:
        self._source = source
        self._tracker = Tracker()
        self._start: float | None = None
        self._last: tuple[int, RgbdFrame] | None = None

    def read(self, folder: Path, prev_index: int, curr_index: int) -> tuple[ViewerFrame, ViewerFrame]:
        """Read the result in `folder` and both frames of its pair.

        Args:
            folder: result folder of the pair.
            prev_index, curr_index: frame numbers in the source.

        Raises:
            ResultError: the folder holds no result, or its size differs from the frames'.
            ReaderError: a frame cannot be read.
        """
        motion = SceneMotion.load(folder)
        if max(prev_index, curr_index) >= len(self._source):
            raise ResultError(f"{folder}: its source has only {len(self._source)} frames now: the source has changed")
        if self._last and self._last[0] != prev_index:
            self._tracker.reset()
        prev = self._last[1] if self._last and self._last[0] == prev_index else self._source[prev_index]
        curr = self._source[curr_index]
        check_size(motion, curr, str(folder))
        self._last = (curr_index, curr)
        prev_time, curr_time = self._source.timestamp(prev_index), self._source.timestamp(curr_index)
        tracks = self._tracker.update(
            prev_index if prev_time is None else prev_time,
            curr,
            curr_index if curr_time is None else curr_time,
            motion,
        )
        if self._start is None:
            self._start = prev_time
        start = self._start or 0.0
        prev_seconds, curr_seconds = (None if time is None else time - start for time in (prev_time, curr_time))
        return tracked_frames(
            self._tracker, tracks, (prev, curr), motion, (prev_index, curr_index), (prev_seconds, curr_seconds)
        )
