"""Threads that compute beside the calling one, where the process may use several cores.

torch, OpenCV and NumPy release the interpreter's lock while they compute. A side thread computes with one thread of
torch, so its results do not depend on the number of cores.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from functools import lru_cache
from threading import Barrier
from typing import TypeVar

T = TypeVar("T")


def has_side_threads() -> bool:
    """Whether work may run beside the calling thread: torch may use several threads there.

    This is false with `OMP_NUM_THREADS=1`, after `torch.set_num_threads(1)`, in forked children and in side threads.
    """
    import torch

    return torch.get_num_threads() > 1


def start_beside(work: Callable[[], T]) -> Future[T]:
    """Start a work in a side thread; only where `has_side_threads`.

    Works start in the order of these calls, so a work may wait for those that were started before it.
    """
    import torch

    return _threads(os.getpid(), torch.get_num_threads()).submit(work)


def side_by_side(*works: Callable[[], T]) -> list[T]:
    """The results of works that run beside each other, or one after the other where there are no side threads.

    Raises:
        BaseException: of the first work that failed, after all works have ended.
    """
    if len(works) < 2 or not has_side_threads():
        return [work() for work in works]
    started = [start_beside(work) for work in works[1:]]
    try:
        first = works[0]()
    finally:
        for one in started:
            one.exception()  # waits
    return [first, *(one.result() for one in started)]


@lru_cache(maxsize=1)
def _threads(process: int, count: int) -> ThreadPoolExecutor:
    """The side threads of a process; a forked child, which inherits none, gets its own."""
    import torch

    del process
    started = Barrier(count)

    def start() -> None:
        torch.get_num_threads()  # a thread takes over the common number once, when torch first asks for it
        torch.set_num_threads(1)
        started.wait()

    threads = ThreadPoolExecutor(count, thread_name_prefix="beside")
    for one in [threads.submit(start) for _ in range(count)]:
        one.result()
    # Each thread has its own number, but new threads start with the number that was set last.
    torch.set_num_threads(count)
    return threads
