"""The newest frame of a source: frames that are not fetched in time are dropped instead of queued."""

from __future__ import annotations

import math
import threading
from collections.abc import Iterable, Iterator
from types import TracebackType
from typing import NamedTuple

from objectflow.frame import RgbdFrame


class FrameTaken(NamedTuple):
    """A frame of a source.

    Attributes:
        number: of the frame in the source, from 0.
        frame: the frame.
        part: how often the time went back before it: a clock was set back, or a recording restarted.
    """

    number: int
    frame: RgbdFrame
    part: int


class NewestFrame:
    """Reads a source in a thread and keeps only its newest frame.

    Use it in a `with` block: leaving the block ends the thread and closes the source if it has `close`.
    """

    def __init__(self, source: Iterable[RgbdFrame]) -> None:
        self._source = source
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

    def _is_newer(self, after: int) -> bool:
        return self._newest is not None and self._newest.number > after

    def _read(self) -> None:
        frames: Iterator[RgbdFrame] = iter(self._source)
        part, last = 0, -math.inf
        try:
            for number, frame in enumerate(frames):
                # Every frame is looked at here: the consumer may not see the one at which the time went back.
                if frame.timestamp is not None:
                    part += frame.timestamp < last
                    last = frame.timestamp
                with self._changed:
                    if self._stop:
                        break
                    self._newest = FrameTaken(number, frame, part)
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
