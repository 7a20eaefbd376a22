"""Graceful termination: after the first Ctrl-C, SIGTERM or SIGHUP, the step finishes and a checkpoint is written."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType, TracebackType
from typing import Any

MESSAGE = b"\nobjectflow: finishing this step and saving a checkpoint; Ctrl-C again stops without one\n"
"""Printed on the first signal."""

_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class GracefulStop:
    """Context manager that records the first signal; a second one has its usual effect.

    Attributes:
        signal: number of the signal received, 0 if none.
    """

    def __init__(self) -> None:
        self.signal = 0
        self._before: dict[signal.Signals, Any] = {}

    def __enter__(self) -> GracefulStop:
        # Python handles signals in the main thread only; a run in another thread is stopped by its caller.
        if threading.current_thread() is threading.main_thread():
            # nohup starts a run with SIGHUP ignored, which stays so.
            heard = [number for number in _SIGNALS if signal.getsignal(number) != signal.SIG_IGN]
            self._before = {number: signal.signal(number, self._note) for number in heard}
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._restore()

    @contextmanager
    def ignored_by_children(self) -> Iterator[None]:
        """Let processes started inside ignore Ctrl-C, which a terminal sends to all; this process ends them."""
        before = signal.signal(signal.SIGINT, signal.SIG_IGN) if self._before else None
        try:
            yield
        finally:
            if before is not None:
                signal.signal(signal.SIGINT, before)

    def _note(self, number: int, frame: FrameType | None) -> None:
        self.signal = number
        self._restore()
        if number == signal.SIGINT:
            # One write, since a signal may arrive while another message is printed.
            os.write(2, MESSAGE)

    def _restore(self) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)
        self._before = {}
