"""A polite end: the first Ctrl-C or SIGTERM lets the step finish and a checkpoint be written."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType, TracebackType
from typing import Any

_SIGNALS = (signal.SIGINT, signal.SIGTERM)


class GracefulStop:
    """While entered, takes note of a signal instead of dying from it; a second one acts as it always would.

    Attributes:
        signal: the number of the one that came, 0 before.
    """

    def __init__(self) -> None:
        self.signal = 0
        self._before: dict[signal.Signals, Any] = {}

    def __enter__(self) -> GracefulStop:
        # Python handles signals in its main thread alone; a run in another one is stopped by whoever started it.
        if threading.current_thread() is threading.main_thread():
            self._before = {number: signal.signal(number, self._note) for number in _SIGNALS}
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._restore()

    @contextmanager
    def kept_from_children(self) -> Iterator[None]:
        """Processes started inside ignore Ctrl-C, which a terminal sends to all: this one ends them itself."""
        before = signal.signal(signal.SIGINT, signal.SIG_IGN) if self._before else None
        try:
            yield
        finally:
            if before is not None:
                signal.signal(signal.SIGINT, before)

    def _note(self, number: int, frame: FrameType | None) -> None:
        self.signal = number
        self._restore()

    def _restore(self) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)
        self._before = {}
