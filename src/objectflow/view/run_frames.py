"""The results of a run as viewer frames, with the tracks, masks and models that the run wrote."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from objectflow.errors import ResultError
from objectflow.frame import RgbdFrame
from objectflow.motion import SceneMotion
from objectflow.readers import FrameSource
from objectflow.tracking.track import Track, next_camera_pose
from objectflow.tracking.tracker import Tracker
from objectflow.typing import Float64Array, LabelImage
from objectflow.view.run_page.contents import pose_at
from objectflow.view.viewer_frames import ViewerFrame, check_size, posed_frames, tracked_frames


class RunFrames:
    """Reads the results of a finished run pair by pair, in order.

    Objects have the ids, masks and poses of the run. One at rest stays at its last pose in the frames that show it;
    one that is hidden or was taken away is left out.
    """

    def __init__(
        self,
        source: FrameSource,
        tracks: Sequence[Track],
        read_known: Callable[[Path], LabelImage],
        models: Mapping[int, Path],
    ) -> None:
        """Prepare the frames of a run.

        Args:
            source: its frames.
            tracks: those it wrote; where a model was registered, with its registered poses.
            read_known: (H, W) track ids by the folder of a pair.
            models: model files by track id.
        """
        self._source, self._tracks, self._read_known, self._models = source, tracks, read_known, models
        self._reader = _PairReader(source)
        self._world_T_camera: Float64Array = np.eye(4)
        self._last: int | None = None
        self._started: list[Track] = []
        self._ended: set[int] = set()

    def read(self, folder: Path, prev_index: int, curr_index: int) -> tuple[ViewerFrame, ViewerFrame]:
        """Read the result in `folder` and both frames of its pair.

        Args:
            folder: result folder of the pair.
            prev_index, curr_index: frame numbers in the source.

        Raises:
            ResultError: the folder holds no result, or its size differs from the frames'.
            ReaderError: a frame or `known.png` cannot be read.
        """
        frames, motion = self._reader.read(folder, prev_index, curr_index)
        cameras, tracks = self._advance(motion, prev_index, curr_index)
        prev_time, curr_time = self._time(prev_index), self._time(curr_index)
        known = self._read_known(folder)
        seen = {int(number) for number in np.unique(known)}
        poses = {}
        for track in self._started:
            if track.id not in seen and curr_time not in track.times:
                continue
            before, after = (pose_at(track.times, track.world_T_object, time) for time in (prev_time, curr_time))
            if after is not None:
                poses[track.id] = (after if before is None else before, after)
        return posed_frames(
            poses,
            tracks,
            cameras,
            frames,
            motion,
            (prev_index, curr_index),
            self._reader.seconds(prev_index, curr_index),
            known,
            self._models,
        )

    def skip(self, folder: Path, prev_index: int, curr_index: int) -> None:
        """Take in a pair before the one to show, without its frames."""
        self._reader.start(prev_index)
        self._advance(SceneMotion.load(folder), prev_index, curr_index)

    def _time(self, index: int) -> float:
        time = self._source.timestamp(index)
        return float(index) if time is None else time

    def _advance(
        self, motion: SceneMotion, prev_index: int, curr_index: int
    ) -> tuple[tuple[Float64Array, Float64Array], dict[int, int]]:
        """Continue the camera's pose; return that of both frames, and the track id of each object that moved."""
        world_T_curr = next_camera_pose(self._world_T_camera, motion)
        if self._last != prev_index or world_T_curr is None:
            # A new world starts, and the objects of the last one are not shown any more.
            self._ended |= {track.id for track in self._started}
            self._started = []
            self._world_T_camera = np.eye(4)
            world_T_curr = next_camera_pose(self._world_T_camera, motion)
        self._last = curr_index
        if world_T_curr is None:
            return (np.eye(4), np.eye(4)), {}
        cameras = self._world_T_camera, world_T_curr
        self._world_T_camera = world_T_curr
        time, found = self._time(curr_index), {}
        for track in self._tracks:
            label = dict(zip(track.times, track.labels, strict=True)).get(time, 0)
            if track.id in self._ended:
                continue
            if label:
                found[label] = track.id
            # A track has its first pose in the frame before its first step.
            if (label or track.times[0] == time) and track not in self._started:
                self._started.append(track)
        self._started.sort(key=lambda track: track.id)
        return cameras, found


class UnfinishedRunFrames:
    """Reads the results of a run that has not written its tracks yet; ids may differ from those it will write."""

    def __init__(self, source: FrameSource) -> None:
        self._source = source
        self._reader = _PairReader(source)
        self._tracker = Tracker()
        self._last: int | None = None

    def read(self, folder: Path, prev_index: int, curr_index: int) -> tuple[ViewerFrame, ViewerFrame]:
        """Read the result in `folder` and both frames of its pair; see `RunFrames.read`."""
        frames, motion = self._reader.read(folder, prev_index, curr_index)
        if self._last != prev_index:
            self._tracker.reset()
        self._last = curr_index
        prev_time, curr_time = self._source.timestamp(prev_index), self._source.timestamp(curr_index)
        tracks = self._tracker.update(
            prev_index if prev_time is None else prev_time,
            frames[1],
            curr_index if curr_time is None else curr_time,
            motion,
        )
        seconds = self._reader.seconds(prev_index, curr_index)
        return tracked_frames(self._tracker, tracks, frames, motion, (prev_index, curr_index), seconds)


class _PairReader:
    """Reads the frames of consecutive pairs, each frame once."""

    def __init__(self, source: FrameSource) -> None:
        self._source = source
        self._last: tuple[int, RgbdFrame] | None = None
        self._first: int | None = None

    def start(self, index: int) -> None:
        """State the first frame, from which seconds are counted."""
        self._first = index if self._first is None else self._first

    def read(self, folder: Path, prev_index: int, curr_index: int) -> tuple[tuple[RgbdFrame, RgbdFrame], SceneMotion]:
        motion = SceneMotion.load(folder)
        if max(prev_index, curr_index) >= len(self._source):
            raise ResultError(f"{folder}: its source has only {len(self._source)} frames now: the source has changed")
        self.start(prev_index)
        prev = self._last[1] if self._last and self._last[0] == prev_index else self._source[prev_index]
        curr = self._source[curr_index]
        check_size(motion, curr, str(folder))
        self._last = (curr_index, curr)
        return (prev, curr), motion

    def seconds(self, prev_index: int, curr_index: int) -> tuple[float | None, float | None]:
        """Times of two frames since the first one; None where the source has none."""
        start = None if self._first is None else self._source.timestamp(self._first)
        times = (self._source.timestamp(index) for index in (prev_index, curr_index))
        prev, curr = (None if time is None else time - (start or 0.0) for time in times)
        return prev, curr
