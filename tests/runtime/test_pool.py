"""Pools yield results in the order of the jobs and raise the errors of jobs."""

from __future__ import annotations

import multiprocessing
import os
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from objectflow.errors import DatasetError, MethodError
from objectflow.runtime.make_pool import make_pool
from objectflow.runtime.pool import MAX_AHEAD, in_order


def square(number: int) -> int:
    if number < 0:
        raise DatasetError(f"{number} is negative")
    time.sleep(0.02 * (number % 3))
    return number * number


def make_square() -> Callable[[int], int]:
    return square


@pytest.mark.parametrize("workers", [1, 2])
def test_results_come_in_the_order_of_the_jobs(workers: int) -> None:
    pool = make_pool(make_square, workers)
    try:
        assert list(pool.run(iter(range(9)))) == [number * number for number in range(9)]
        assert list(pool.run([])) == []
        with pytest.raises(DatasetError, match="-1 is negative"):
            list(pool.run([2, -1, 3]))
    finally:
        pool.close()


def make_look() -> Callable[[str], str | None]:
    return os.environ.get


def test_linear_algebra_of_workers_shares_the_cores_unless_the_user_chose(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("OPENBLAS_NUM_THREADS", raising=False)
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(6)), raising=False)
    pool = make_pool(make_look, 2)
    try:
        assert list(pool.run(["OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"])) == ["3", "7"]
    finally:
        pool.close()
    assert "OPENBLAS_NUM_THREADS" not in os.environ


def test_less_than_one_worker_is_refused() -> None:
    with pytest.raises(MethodError, match="--workers must be at least 1, not 0"):
        make_pool(make_square, 0)


def test_jobs_are_drawn_only_a_few_ahead_of_the_results() -> None:
    drawn: list[int] = []
    queue: list[tuple[str, int]] = []

    def jobs() -> object:
        for number in range(100):
            drawn.append(number)
            yield number

    def receive(busy: list[str]) -> tuple[str, int]:
        # The second worker answers first, as long as it is busy.
        worker, number = next((entry for entry in queue if entry[0] == "b"), queue[0])
        queue.remove((worker, number))
        return worker, number

    results = in_order(jobs(), ["a", "b"], lambda worker, job: queue.append((worker, job)), receive)  # type: ignore[arg-type, var-annotated]
    for expected in range(20):
        assert next(results) == expected
        assert len(drawn) <= expected + 1 + 2 * MAX_AHEAD


class Sleeper:
    """Writes its worker's number to a file, then works for longer than any test."""

    def __call__(self, path: str) -> None:
        Path(path).write_text(str(os.getpid()))
        time.sleep(600)


def make_sleeper() -> Callable[[str], None]:
    return Sleeper()


def hold_a_pool(path: str) -> None:
    list(make_pool(make_sleeper, 2).run([path]))


def test_busy_workers_end_with_a_killed_parent(tmp_path: Path) -> None:
    file = tmp_path / "worker"
    parent = multiprocessing.get_context("spawn").Process(target=hold_a_pool, args=(str(file),))
    parent.start()
    worker = int(waited(lambda: file.is_file() and file.read_text()))
    parent.kill()
    parent.join()
    assert waited(lambda: not runs(worker))


def waited(condition: Callable[[], str | bool]) -> str | bool:
    """The first true value of a condition within a minute."""
    end = time.monotonic() + 60
    while time.monotonic() < end:
        value = condition()
        if value:
            return value
        time.sleep(0.05)
    return False


def runs(process: int) -> bool:
    try:
        os.kill(process, 0)
        return "Z" not in Path(f"/proc/{process}/stat").read_text().split(")")[1]
    except (ProcessLookupError, FileNotFoundError):
        return False
