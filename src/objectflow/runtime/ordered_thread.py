"""A thread that works beside the calling one, in the order in which it is given work."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from types import TracebackType

MAX_WAITING = 2
"""Default number of works that are unfinished at a time; bounds memory."""


class OrderedThread:
    """Runs works in one other thread, one after the other; use it in a `with` block.

    The first work that fails ends the series: later ones do not start, and its exception is raised in the calling
    thread. At the end of the block all works are finished, also after an exception or an interrupt.

    Args:
        max_waiting: number of works that may be unfinished; `submit` waits while there are more.
    """

    def __init__(self, max_waiting: int = MAX_WAITING) -> None:
        self._pool = ThreadPoolExecutor(max_workers=1, thread_name_prefix="ordered")
        self._waiting: deque[Future[None]] = deque()
        self._max_waiting = max_waiting
        self._failed = False

    def submit(self, work: Callable[[], object]) -> None:
        """Run a work after those submitted before.

        Raises:
            BaseException: of an earlier work.
        """
        self._wait(self._max_waiting - 1)
        self._waiting.append(self._pool.submit(self._run, work))

    def finish(self) -> None:
        """Wait for all works.

        Raises:
            BaseException: of the first work that failed.
        """
        self._wait(0)

    def __enter__(self) -> OrderedThread:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if kind is None:
                self.finish()
        finally:
            self._pool.shutdown(wait=True)

    def _wait(self, count: int) -> None:
        """Wait until at most `count` works are unfinished."""
        while self._waiting and (len(self._waiting) > count or self._waiting[0].done()):
            self._waiting.popleft().result()

    def _run(self, work: Callable[[], object]) -> None:
        if self._failed:
            return
        try:
            work()
        except BaseException:  # also an interrupt: the result of this work is missing
            self._failed = True
            raise
