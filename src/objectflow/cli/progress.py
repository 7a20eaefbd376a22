"""Progress of long commands: a bar on a terminal, a line every ten seconds elsewhere."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import Progress

INTERVAL = 10.0
"""Time between two lines, seconds."""


@contextmanager
def show_progress(
    name: str, total: int, *, clock: Callable[[], float] = time.monotonic
) -> Iterator[Callable[[], None]]:
    """Yield a function to call after each step.

    Args:
        name: of the steps, in the plural.
        total: number of steps.
        clock: monotonic clock, seconds.
    """
    # A copy of the descriptor: standard error may be silenced while libraries are at work.
    with os.fdopen(os.dup(2), "w", encoding="utf-8", errors="replace") as stream:
        console = Console(file=stream)
        if console.is_terminal:
            with Progress(console=console, transient=True) as progress:
                task = progress.add_task(name, total=total)
                yield lambda: progress.advance(task)
            return
        start = last = clock()
        done = 0

        def advance() -> None:
            nonlocal done, last
            done += 1
            now = clock()
            if now - last >= INTERVAL and done < total:
                last = now
                each = (now - start) / done
                left = each * (total - done)
                stream.write(f"{done} of {total} {name}, {each:.2f} s each, about {_duration(left)} left\n")
                stream.flush()

        yield advance


def _duration(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 120 else f"{seconds / 60:.0f} min"
