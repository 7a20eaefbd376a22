"""Playback of a recording in real time."""

from __future__ import annotations

import time
from collections.abc import Callable, Generator

from objectflow.frame import RgbdFrame
from objectflow.readers import FrameSource


def replay(
    source: FrameSource,
    *,
    rate: float = 30.0,
    speed: float = 1.0,
    loop: bool = False,
    clock: Callable[[], float] = time.monotonic,
    sleep: Callable[[float], None] = time.sleep,
) -> Generator[RgbdFrame, None, None]:
    """Yield each frame at its time; frames that are overdue when the next one is due are skipped.

    Args:
        source: the recording.
        rate: frames per second, where the source has no times.
        speed: playback speed; 2 is twice as fast.
        loop: restart at the end, endlessly.
        clock: monotonic clock, seconds.
        sleep: waits for a number of seconds.
    """
    count = len(source)
    stamps = [source.timestamp(index) for index in range(count)]
    times = [index / rate if stamp is None else stamp for index, stamp in enumerate(stamps)]
    while True:
        start = clock()
        for index in range(count):
            due = start + (times[index] - times[0]) / speed
            wait = due - clock()
            if wait < 0 and index + 1 < count and clock() >= start + (times[index + 1] - times[0]) / speed:
                continue
            if wait > 0:
                sleep(wait)
            yield source[index]
        if not loop:
            return
