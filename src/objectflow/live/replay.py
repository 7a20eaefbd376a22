"""Playback of a recording in real time."""

from __future__ import annotations

import time
from collections.abc import Callable, Generator

import numpy as np

from objectflow.errors import FrameError, ReaderError
from objectflow.frame import RgbdFrame
from objectflow.readers import FrameSource

MAX_WAIT_S = 1.0
"""Longest time between two frames of a playback, seconds; longer pauses of a recording are shortened."""


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

    Frames that cannot be read are left out. The playback goes on without a pause where the time of a recording goes
    back.

    Args:
        source: the recording.
        rate: frames per second, where the source has no times.
        speed: playback speed; 2 is twice as fast.
        loop: restart at the end, endlessly.
        clock: monotonic clock, seconds.
        sleep: waits for a number of seconds.

    Raises:
        ReaderError, FrameError: no frame of the recording can be read.
    """
    count = len(source)
    stamps = [source.timestamp(index) for index in range(count)]
    times = [index / rate if stamp is None else stamp for index, stamp in enumerate(stamps)]
    steps = np.clip(np.diff(times), 0.0, MAX_WAIT_S * speed)
    offsets = (np.concatenate([[0.0], np.cumsum(steps)]) / speed).tolist()
    error: ReaderError | FrameError | None = None
    has_read = False
    while True:
        start = clock()
        for index in range(count):
            wait = start + offsets[index] - clock()
            if wait < 0 and index + 1 < count and clock() >= start + offsets[index + 1]:
                continue
            if wait > 0:
                sleep(wait)
            try:
                frame = source[index]
            except (ReaderError, FrameError) as found:
                error = error or found
                continue
            has_read = True
            yield frame
        if error is not None and not has_read:
            raise error
        if not loop:
            return
