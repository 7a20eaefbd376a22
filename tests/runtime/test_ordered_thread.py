from __future__ import annotations

import threading
from functools import partial

import pytest

from objectflow.errors import StorageError
from objectflow.runtime.ordered_thread import OrderedThread


def fail() -> None:
    raise StorageError("no space")


def test_works_run_in_order_in_another_thread() -> None:
    done: list[tuple[int, bool]] = []
    main = threading.get_ident()
    with OrderedThread() as thread:
        for number in range(20):
            thread.submit(lambda number=number: done.append((number, threading.get_ident() != main)))  # type: ignore[misc]
    assert done == [(number, True) for number in range(20)]


def test_the_calling_thread_goes_on_until_too_many_works_wait() -> None:
    gate, submitted, done = threading.Event(), [], []

    def submit() -> None:
        with OrderedThread(max_waiting=2) as thread:
            for number in range(4):
                thread.submit(lambda: (gate.wait(), done.append(None)))
                submitted.append(number)

    caller = threading.Thread(target=submit)
    caller.start()
    caller.join(timeout=0.3)
    assert caller.is_alive()
    assert (submitted, done) == ([0, 1], [])
    gate.set()
    caller.join(timeout=10)
    assert len(submitted) == len(done) == 4


@pytest.mark.parametrize("ends", ["finish", "submit", "exit"])
def test_the_first_failure_is_raised_and_nothing_after_it_runs(ends: str) -> None:
    done: list[int] = []

    def use() -> None:
        with OrderedThread(max_waiting=4) as thread:
            thread.submit(partial(done.append, 0))
            thread.submit(fail)
            thread.submit(partial(done.append, 1))
            if ends == "finish":
                thread.finish()
            if ends == "submit":
                for number in range(2, 10):
                    thread.submit(partial(done.append, number))
            done.extend([] if ends == "exit" else [99])

    with pytest.raises(StorageError, match="no space"):
        use()
    assert done == [0]


def test_works_that_wait_are_finished_when_the_block_is_interrupted() -> None:
    done: list[int] = []

    def use() -> None:
        with OrderedThread() as thread:
            thread.submit(partial(done.append, 0))
            thread.submit(partial(done.append, 1))
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        use()
    assert done == [0, 1]
