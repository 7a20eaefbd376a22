"""Live tracking of objects: each estimate runs from the last processed frame to the newest frame."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

from objectflow.frame import RgbdFrame
from objectflow.live.newest_frame import FrameTaken, NewestFrame
from objectflow.methods.base import Estimator
from objectflow.motion import SceneMotion
from objectflow.tracking.sequence_estimator import SequenceEstimator
from objectflow.tracking.tracker import Tracker
from objectflow.typing import LabelImage


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
        known: (H, W) int32, track id of each pixel that shows an object that has moved before, 0 elsewhere; None where
            known objects are not followed.
    """

    prev: RgbdFrame
    curr: RgbdFrame
    motion: SceneMotion
    tracks: Mapping[int, int]
    times: tuple[float, float]
    latency: float
    dropped: int
    known: LabelImage | None = None


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
    sequence = SequenceEstimator(estimator, tracker=tracker)
    sequence.update(prev.frame, prev_time)
    while (curr := source.take(number)) is not None:
        number = curr.number
        taken, curr_time = clock(), _time_of(curr, clock)
        if curr.part != prev.part:
            # The recording restarted or the clock was set back, so tracking restarts here.
            prev, prev_time = curr, curr_time
            sequence.cut()
            sequence.update(prev.frame, prev_time)
            continue
        if curr_time - prev_time < min_gap or curr_time <= prev_time:
            continue
        step = sequence.update(curr.frame, curr_time)
        if step is None:
            continue
        yield Step(
            prev=prev.frame,
            curr=curr.frame,
            motion=step.motion,
            tracks=step.tracks,
            known=step.known,
            times=(prev_time, curr_time),
            latency=clock() - taken,
            dropped=curr.number - prev.number - 1,
        )
        prev, prev_time = curr, curr_time


def _time_of(taken: FrameTaken, clock: Callable[[], float]) -> float:
    return clock() if taken.frame.timestamp is None else taken.frame.timestamp
