"""Worker pools with results in the order of the jobs, whichever worker finishes first."""

from __future__ import annotations

import multiprocessing
import os
import signal
import traceback
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from multiprocessing.connection import Connection, wait
from typing import Any, Generic, Protocol, TypeVar

from objectflow.errors import DatasetError, ObjectflowError
from objectflow.runtime.memory import keep_freed_memory
from objectflow.runtime.parent import end_with_parent
from objectflow.runtime.threads import shared_environment

MAX_AHEAD = 4
"""Maximum number of jobs per worker that are started ahead of the next result; bounds memory."""

Job = TypeVar("Job")
Result = TypeVar("Result")
Worker = TypeVar("Worker")
_Job_contra = TypeVar("_Job_contra", contravariant=True)
_Result_co = TypeVar("_Result_co", covariant=True)


class Pool(Protocol[_Job_contra, _Result_co]):
    """A pool that runs jobs, some of them ahead of time."""

    def run(self, jobs: Iterable[_Job_contra]) -> Iterator[_Result_co]:
        """The results, in the order of the jobs; jobs are drawn from the iterable a few at a time."""
        ...

    def close(self) -> None:
        """End all workers and drop their unfinished jobs."""
        ...


class InProcess(Generic[Job, Result]):
    """A pool without workers: jobs run in the calling process.

    Args:
        factory: builds the function that runs jobs; called at the first job.
    """

    def __init__(self, factory: Callable[[], Callable[[Job], Result]]) -> None:
        self._factory = factory
        self._function: Callable[[Job], Result] | None = None

    def run(self, jobs: Iterable[Job]) -> Iterator[Result]:
        """See `Pool`."""
        for job in jobs:
            self._function = self._function or self._factory()
            yield self._function(job)

    def close(self) -> None:
        """See `Pool`."""


class Processes(Generic[Job, Result]):
    """Worker processes on this machine, each with its own pipe.

    Workers end when their parent exits or is killed, an idle one at once and a busy one within a second. The pools of
    the standard library share one queue, which the sibling processes keep open, so that orphaned workers wait forever.

    Args:
        factory: builds, inside each worker, the function that runs jobs; picklable.
        workers: number of processes.
    """

    def __init__(self, factory: Callable[[], Callable[[Job], Result]], workers: int) -> None:
        context = multiprocessing.get_context("spawn")
        self._processes: dict[Connection, multiprocessing.process.BaseProcess] = {}
        for _ in range(workers):
            ours, theirs = context.Pipe()
            process = context.Process(target=_work, args=(theirs, factory, os.getpid()), daemon=True)
            with shared_environment(workers):
                process.start()
            theirs.close()
            self._processes[ours] = process

    def run(self, jobs: Iterable[Job]) -> Iterator[Result]:
        """See `Pool`.

        Raises:
            DatasetError: a worker process ended unexpectedly.
        """
        return in_order(jobs, list(self._processes), self._send, self._receive)

    def close(self) -> None:
        """See `Pool`."""
        for connection, process in self._processes.items():
            connection.close()
            process.terminate()
        for process in self._processes.values():
            process.join()
        self._processes = {}

    def _send(self, worker: Connection, job: Job) -> None:
        # The death of a worker is reported by `_receive`.
        with suppress(BrokenPipeError):
            worker.send(job)

    def _receive(self, busy: list[Connection]) -> tuple[Connection, Result]:
        ready = wait(busy)[0]
        worker = next(connection for connection in busy if connection is ready)
        try:
            result = worker.recv()
        except (EOFError, ConnectionResetError):
            process = self._processes[worker]
            process.join()
            raise DatasetError(
                f"a worker process ended (exit code {process.exitcode}; was there too little memory?): "
                "run the same command again, with fewer --workers"
            ) from None
        if isinstance(result, BaseException):
            raise result
        return worker, result


def in_order(
    jobs: Iterable[Job],
    workers: list[Worker],
    send: Callable[[Worker, Job], None],
    receive: Callable[[list[Worker]], tuple[Worker, Result]],
) -> Iterator[Result]:
    """Keep all workers busy and yield their results in the order of the jobs.

    Args:
        jobs: what to run.
        workers: handles, hashable, all idle.
        send: hands a job to an idle worker.
        receive: waits for any of the busy workers, which is idle afterwards.
    """
    numbered = enumerate(jobs)
    idle, busy, done = list(workers), dict[Worker, int](), dict[int, Result]()
    limit = MAX_AHEAD * len(workers)
    wanted, more = 0, True
    while True:
        while more and idle and len(busy) + len(done) < limit:
            following = next(numbered, None)
            if following is None:
                more = False
            else:
                worker = idle.pop()
                send(worker, following[1])
                busy[worker] = following[0]
        if wanted in done:
            yield done.pop(wanted)
            wanted += 1
        elif busy:
            worker, result = receive(list(busy))
            done[busy.pop(worker)] = result
            idle.append(worker)
        else:
            return


def _work(connection: Connection, factory: Callable[[], Callable[[Any], Any]], parent: int) -> None:
    """Main loop of a worker process: run jobs until the pipe ends."""
    end_with_parent(parent)
    keep_freed_memory()
    # Ctrl-C reaches the whole process group; only the parent handles it.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    function: Callable[[Any], Any] | None = None
    while True:
        try:
            job = connection.recv()
        except (EOFError, ConnectionResetError):
            return
        try:
            function = function or factory()
            result = function(job)
        except ObjectflowError as error:
            result = error
        except Exception:
            # The exception may not be picklable; its text is sufficient for a bug report.
            result = RuntimeError(f"a worker failed at {job}:\n{traceback.format_exc()}")
        try:
            connection.send(result)
        except (BrokenPipeError, ConnectionResetError):
            return
