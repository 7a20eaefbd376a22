"""Following objects live: estimate between the newest frame and the one before, link ids, go on with the newest."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

from objectflow.frame import RgbdFrame, check_pair
from objectflow.live.newest_frame import FrameTaken, NewestFrame
from objectflow.methods.base import Estimator
from objectflow.motion import SceneMotion
from objectflow.tracking.tracker import Tracker


@dataclass(frozen=True, eq=False)
class Step:
    """One estimate.

    Attributes:
        prev, curr: the frames.
        motion: between them.
        tracks: the lasting id of each object of `motion` that has one.
        times: of the two frames, seconds.
        latency: seconds from taking the current frame to having its motion.
        dropped: frames of the source between the two that nobody looked at.
    """

    prev: RgbdFrame
    curr: RgbdFrame
    motion: SceneMotion
    tracks: dict[int, int]
    times: tuple[float, float]
    latency: float
    dropped: int


def follow(
    latest: NewestFrame,
    estimator: Estimator,
    tracker: Tracker,
    *,
    min_gap: float = 0.0,
    clock: Callable[[], float] = time.monotonic,
) -> Iterator[Step]:
    """Estimate as fast as the method can, always on the newest frame.

    Args:
        latest: the source, entered.
        estimator: the method.
        tracker: links the objects; it has seen nothing yet.
        min_gap: seconds between the two frames at least: things must have had the time to move.
        clock: seconds that only rise; times frames that have no time of their own.

    Raises:
        ObjectflowError: what the source raised, or frames that do not fit together.
    """
    prev: FrameTaken | None = latest.take()
    if prev is None:
        return
    prev_time = _time_of(prev, clock)
    number = prev.number
    while (curr := latest.take(number)) is not None:
        number = curr.number
        taken, curr_time = clock(), _time_of(curr, clock)
        if curr_time - prev_time < min_gap or curr_time <= prev_time:
            if curr_time < prev_time:
                # A recording that starts again, or a clock that was set: begin anew from here.
                prev, prev_time = curr, curr_time
                tracker.reset()
            continue
        check_pair(prev.frame, curr.frame)
        motion = estimator(prev.frame, curr.frame)
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
