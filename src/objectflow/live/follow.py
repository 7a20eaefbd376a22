"""Live tracking of objects: each estimate runs from the last processed frame to the newest frame."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

from objectflow.alignment.frame_pair import FramePair
from objectflow.alignment.prepared_frame import PreparedFrame
from objectflow.frame import RgbdFrame
from objectflow.live.newest_frame import FrameTaken, NewestFrame
from objectflow.methods.base import Estimator, estimate_pair
from objectflow.motion import SceneMotion
from objectflow.tracking.tracker import Tracker


@dataclass(frozen=True, eq=False)
class Step:
    """One estimate.

    Attributes:
        prev, curr: the frames.
        motion: between the frames.
        tracks: track id of each object of `motion` that has a track, by the object's id.
        times: of the two frames, seconds.
        latency: from taking the current frame to the result, seconds.
        dropped: number of source frames between the two that were not processed.
    """

    prev: RgbdFrame
    curr: RgbdFrame
    motion: SceneMotion
    tracks: dict[int, int]
    times: tuple[float, float]
    latency: float
    dropped: int


def follow(
    source: NewestFrame,
    estimator: Estimator,
    tracker: Tracker,
    *,
    min_gap: float = 0.0,
    clock: Callable[[], float] = time.monotonic,
) -> Iterator[Step]:
    """Estimate on the newest frame whenever the method is ready, and track the objects.

    Args:
        source: an entered `NewestFrame`.
        estimator: the method.
        tracker: links the objects; it must be new.
        min_gap: smallest time between the two frames, seconds, so that objects can move measurably.
        clock: monotonic clock, seconds; provides the times of frames without timestamps.

    Raises:
        ObjectflowError: the source failed, or the frames do not match each other.
    """
    prev: FrameTaken | None = source.take()
    if prev is None:
        return
    prev_time = _time_of(prev, clock)
    number = prev.number
    last: PreparedFrame | None = None
    while (curr := source.take(number)) is not None:
        number = curr.number
        taken, curr_time = clock(), _time_of(curr, clock)
        if curr.part != prev.part:
            # The recording restarted or the clock was set back, so tracking restarts here.
            prev, prev_time, last = curr, curr_time, None
            tracker.reset()
            continue
        if curr_time - prev_time < min_gap or curr_time <= prev_time:
            continue
        # What the last estimate computed on its current frame is not computed again.
        pair = FramePair(last or prev.frame, curr.frame)
        motion, last = estimate_pair(estimator, pair), pair.curr
        tracks = tracker.update(prev_time, curr.frame, curr_time, motion)
        yield Step(
            prev=prev.frame,
            curr=curr.frame,
            motion=motion,
            tracks=tracks,
            times=(prev_time, curr_time),
            latency=clock() - taken,
            dropped=curr.number - prev.number - 1,
        )
        prev, prev_time = curr, curr_time


def _time_of(taken: FrameTaken, clock: Callable[[], float]) -> float:
    return clock() if taken.frame.timestamp is None else taken.frame.timestamp
