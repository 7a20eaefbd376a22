"""Live tracking of objects: each estimate runs from the last processed frame to the newest frame.

Estimates take longer than the camera takes for a frame. Between two of them, known objects are followed by their
models, also in frames that arrived during an estimate, so that they need not be found again far from where they were.
"""

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
        latency: from the arrival of the current frame to the result, seconds.
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
    skip_explained: bool = True,
    clock: Callable[[], float] = time.monotonic,
) -> Iterator[Step]:
    """Estimate on the newest frame whenever the method is ready, and track the objects.

    Args:
        source: an entered `NewestFrame`; if it keeps some earlier frames, fast objects are followed better.
        estimator: the method.
        tracker: links the objects; it must be new.
        min_gap: smallest time between the two frames, seconds, so that objects can move measurably.
        skip_explained: see `SequenceEstimator`.
        clock: monotonic clock, seconds; provides the times of frames that have neither a time stamp nor a time of
            arrival.

    Raises:
        ObjectflowError: the source failed, or the frames do not match each other.
    """
    prev: FrameTaken | None = source.take()
    if prev is None:
        return
    prev_time = _time_of(prev, clock)
    number, was_estimated = prev.number, False
    sequence = SequenceEstimator(estimator, tracker=tracker, skip_explained=skip_explained)
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
        step = None
        if skip_explained and was_estimated:
            # Known objects need not be found again far from where they were.
            between = _on_the_way(source.earlier(prev.number), prev, prev_time, curr_time, min_gap, clock)
            if between is not None and between.number < curr.number:
                step = sequence.explain(between.frame, _time_of(between, clock))
                if step is not None:
                    curr, number, curr_time = between, between.number, _time_of(between, clock)
        if step is None:
            step = sequence.update(curr.frame, curr_time)
        if step is None:
            continue
        was_estimated = step.estimated
        yield Step(
            prev=prev.frame,
            curr=curr.frame,
            motion=step.motion,
            tracks=step.tracks,
            known=step.known,
            times=(prev_time, curr_time),
            latency=clock() - (taken if curr.arrived is None else curr.arrived),
            dropped=curr.number - prev.number - 1,
        )
        prev, prev_time = curr, curr_time


def _on_the_way(
    kept: list[FrameTaken],
    prev: FrameTaken,
    prev_time: float,
    curr_time: float,
    min_gap: float,
    clock: Callable[[], float],
) -> FrameTaken | None:
    """The last kept frame up to halfway to the newest one, or the first one.

    Args:
        kept: frames after the previous one, in order.
        prev, prev_time: the previous frame.
        curr_time: of the newest frame.
        min_gap: smallest time between two frames that are compared, seconds.
        clock: see `follow`.
    """
    found = None
    for frame in kept:
        gap = _time_of(frame, clock) - prev_time
        if (
            frame.part == prev.part
            and gap >= max(min_gap, 1e-9)
            and (found is None or gap <= (curr_time - prev_time) / 2)
        ):
            found = frame
    return found


def _time_of(taken: FrameTaken, clock: Callable[[], float]) -> float:
    """The frame's time stamp, or when it arrived where it has none, or else the present time; seconds."""
    if taken.frame.timestamp is not None:
        return taken.frame.timestamp
    return clock() if taken.arrived is None else taken.arrived
