"""Silencing of libraries that write to standard error."""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager


class _Silence:
    """The redirection of file descriptor 2, which all threads share: the last user ends it."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._users = 0
        self._kept = -1

    def begin(self) -> None:
        with self._lock:
            if self._users == 0:
                sys.stderr.flush()
                self._kept = os.dup(2)
                null = os.open(os.devnull, os.O_WRONLY)
                os.dup2(null, 2)
                os.close(null)
            self._users += 1

    def end(self) -> None:
        with self._lock:
            self._users -= 1
            if self._users == 0:
                os.dup2(self._kept, 2)
                os.close(self._kept)


_SILENCE = _Silence()


@contextmanager
def silence_stderr() -> Iterator[None]:
    """Discard everything written to file descriptor 2, by native code as well; exceptions are unaffected.

    Threads may use it at the same time.
    """
    _SILENCE.begin()
    try:
        yield
    finally:
        _SILENCE.end()
