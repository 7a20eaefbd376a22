"""The newest frame of a source, and a few frames before it: what is not fetched in time is dropped, not queued."""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from types import TracebackType
from typing import NamedTuple

from objectflow.frame import RgbdFrame


class FrameTaken(NamedTuple):
    """A frame of a source.

    Attributes:
        number: of the frame in the source, from 0.
        frame: the frame.
        part: how often the time went back before it: a clock was set back, or a recording restarted.
        arrived: when the source delivered it, by a monotonic clock, seconds; None if that is unknown.
    """

    number: int
    frame: RgbdFrame
    part: int
    arrived: float | None = None


class NewestFrame:
    """Reads a source in a thread and keeps only its newest frame, and on request a few before it.

    Use it in a `with` block: leaving the block ends the thread and closes the source if it has `close`.
    """

    def __init__(
        self,
        source: Iterable[RgbdFrame],
        *,
        keep: int = 0,
        spacing: float = 0.0,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Prepare.

        Args:
            source: of the frames.
            keep: number of earlier frames that are kept; see `earlier`.
            spacing: smallest time between kept frames, seconds.
            clock: provides the times of arrival.
        """
        self._source, self._spacing, self._clock = source, spacing, clock
        self._kept: deque[FrameTaken] = deque(maxlen=keep)
        self._changed = threading.Condition()
        self._newest: FrameTaken | None = None
        self._ended = False
        self._stop = False
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._read, name="frames", daemon=True)

    def __enter__(self) -> NewestFrame:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with self._changed:
            self._stop = True
        self._thread.join(timeout=5.0)

    def take(self, after: int = -1, timeout: float | None = None) -> FrameTaken | None:
        """Wait for a frame newer than number `after`.

        Args:
            after: number of the last frame taken.
            timeout: seconds to wait; None waits without limit.

        Returns:
            The newest frame, or None at the end of the source or after the timeout.

        Raises:
            ObjectflowError: the source failed and its earlier frames have been taken.
        """
        with self._changed:
            changed = self._changed.wait_for(lambda: self._is_newer(after) or self._ended, timeout)
            if self._newest is not None and self._newest.number > after:
                return self._newest
            if changed and self._error is not None:
                raise self._error
            return None

    def earlier(self, after: int) -> list[FrameTaken]:
        """The kept frames newer than number `after`, in order; the newest frame of all need not be among them."""
        with self._changed:
            return [one for one in self._kept if one.number > after]

    def _is_newer(self, after: int) -> bool:
        return self._newest is not None and self._newest.number > after

    def _read(self) -> None:
        frames: Iterator[RgbdFrame] = iter(self._source)
        part, last, keep_from = 0, -math.inf, -math.inf
        try:
            for number, frame in enumerate(frames):
                # Every frame is looked at here: the consumer may not see the one at which the time went back.
                if frame.timestamp is not None:
                    part += frame.timestamp < last
                    last = frame.timestamp
                with self._changed:
                    if self._stop:
                        break
                    now = self._clock()
                    self._newest = FrameTaken(number, frame, part, now)
                    if now >= keep_from:
                        self._kept.append(self._newest)
                        keep_from = now + self._spacing
                    self._changed.notify_all()
        except BaseException as error:  # Raised again by `take`, in the consumer's thread.
            self._error = error
        finally:
            close = getattr(frames, "close", None)
            if close is not None:
                close()
            with self._changed:
                self._ended = True
                self._changed.notify_all()
