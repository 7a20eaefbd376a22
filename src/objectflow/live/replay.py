"""A recording at the speed at which it was made."""

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
    """Give each frame at its time; a frame whose time has passed while another was read is left out.

    Args:
        source: the recording.
        rate: frames a second, where the source has no times.
        speed: 2 plays twice as fast.
        loop: start again at the end, for ever.
        clock: seconds that only rise.
        sleep: waits for seconds.
    """
    count = len(source)
    known = [source.timestamp(index) for index in range(count)]
    times = [index / rate if time is None else time for index, time in enumerate(known)]
    while True:
        began = clock()
        for index in range(count):
            due = began + (times[index] - times[0]) / speed
            wait = due - clock()
            if wait < 0 and index + 1 < count and clock() >= began + (times[index + 1] - times[0]) / speed:
                continue
            if wait > 0:
                sleep(wait)
            yield source[index]
        if not loop:
            return
