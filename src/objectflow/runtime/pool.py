"""Scenes made by many processes, handed on in order: the result does not depend on who made which."""

from __future__ import annotations

import multiprocessing
import signal
import traceback
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from multiprocessing.connection import Connection, wait
from typing import Any, Protocol

from objectflow.errors import DatasetError, ObjectflowError
from objectflow.synth.generation.tasks import Maker, MakerFactory, SceneRows, Task

AHEAD = 4
"""Scenes a worker may be ahead of the one that is waited for; bounds the memory that finished ones take."""


class Pool(Protocol):
    """Something that makes scenes, in order, some ahead of time."""

    def run(self, tasks: Iterable[Task]) -> Iterator[SceneRows]:
        """The scenes of the tasks, in the tasks' order."""
        ...

    def close(self) -> None:
        """End all workers; what they were about to make is dropped."""
        ...


class InProcess:
    """No workers: scenes are made by the caller's own process."""

    def __init__(self, factory: MakerFactory) -> None:
        self._factory = factory
        self._maker: Maker | None = None

    def run(self, tasks: Iterable[Task]) -> Iterator[SceneRows]:
        """See `Pool`."""
        for task in tasks:
            self._maker = self._maker or self._factory()
            yield self._maker(task)

    def close(self) -> None:
        """See `Pool`."""


class Processes:
    """Worker processes on this machine, each with a pipe of its own.

    A worker whose parent is gone, killed or not, reads the end of its pipe and ends too. (The standard library's
    pools share one queue, whose other end the siblings keep open: their workers would wait for ever.)
    """

    def __init__(self, factory: MakerFactory, workers: int) -> None:
        context = multiprocessing.get_context("spawn")
        self._processes: dict[Connection, multiprocessing.process.BaseProcess] = {}
        for _ in range(workers):
            ours, theirs = context.Pipe()
            process = context.Process(target=_work, args=(theirs, factory), daemon=True)
            process.start()
            theirs.close()
            self._processes[ours] = process

    def run(self, tasks: Iterable[Task]) -> Iterator[SceneRows]:
        """See `Pool`."""
        return in_order(tasks, list(self._processes), self._send, self._receive)

    def close(self) -> None:
        """See `Pool`."""
        for connection, process in self._processes.items():
            connection.close()
            process.terminate()
        for process in self._processes.values():
            process.join()
        self._processes = {}

    def _send(self, worker: Connection, task: Task) -> None:
        # A worker that died is found when its answer is read; the message about it is made there.
        with suppress(BrokenPipeError):
            worker.send(task)

    def _receive(self, busy: list[Connection]) -> tuple[Connection, SceneRows]:
        ready = wait(busy)[0]
        worker = next(connection for connection in busy if connection is ready)
        try:
            answer = worker.recv()
        except (EOFError, ConnectionResetError):
            process = self._processes[worker]
            process.join()
            raise DatasetError(
                f"a worker process ended (exit code {process.exitcode}; was there too little memory?): "
                "run the same command again, with fewer --workers"
            ) from None
        if isinstance(answer, BaseException):
            raise answer
        return worker, answer


def in_order(
    tasks: Iterable[Task],
    workers: list[Any],
    send: Callable[[Any, Task], None],
    receive: Callable[[list[Any]], tuple[Any, SceneRows]],
) -> Iterator[SceneRows]:
    """Keep all workers busy and yield their results in the order of the tasks.

    Args:
        tasks: what to do.
        workers: handles, all idle.
        send: hands a task to an idle worker.
        receive: waits for any of the busy workers, which is then idle.
    """
    numbered = enumerate(tasks)
    idle, busy, done = list(workers), dict[Any, int](), dict[int, SceneRows]()
    limit = AHEAD * len(workers)
    wanted, more = 0, True
    while True:
        while more and idle and len(busy) + len(done) < limit:
            number, task = next(numbered, (-1, None))
            if task is None:
                more = False
            else:
                worker = idle.pop()
                send(worker, task)
                busy[worker] = number
        if wanted in done:
            yield done.pop(wanted)
            wanted += 1
        elif busy:
            worker, result = receive(list(busy))
            done[busy.pop(worker)] = result
            idle.append(worker)
        else:
            return


def _work(connection: Connection, factory: MakerFactory) -> None:
    """A worker's life: make what is asked for until the pipe ends."""
    # Ctrl-C reaches the whole process group; the parent alone answers it.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    maker: Maker | None = None
    while True:
        try:
            task = connection.recv()
        except (EOFError, ConnectionResetError):
            return
        answer: SceneRows | BaseException
        try:
            maker = maker or factory()
            answer = maker(task)
        except ObjectflowError as error:
            answer = error
        except Exception:
            # The exception itself may not be picklable; its text is what a bug report needs.
            answer = RuntimeError(f"a worker failed at {task}:\n{traceback.format_exc()}")
        try:
            connection.send(answer)
        except (BrokenPipeError, ConnectionResetError):
            return
