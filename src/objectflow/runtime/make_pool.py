"""Jobs handed to this process, to processes of this machine, or to a Ray cluster; answers come in order.

The pools are those that make data sets: they neither look into jobs nor into answers.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import Any, cast

from objectflow.errors import MethodError
from objectflow.runtime.pool import InProcess, Pool, Processes


class Workers:
    """A pool of workers, each with a function of its own.

    Args:
        factory: makes the function inside each worker; picklable.
        count: how many; 1 without Ray is this process.
        ray: address of a Ray cluster, "local" for one on this machine, None for none.

    Raises:
        MethodError: fewer than one.
        DatasetError: no cluster at this address.
        MissingExtraError: Ray is not installed.
    """

    def __init__(self, factory: Callable[[], Callable[[Any], Any]], count: int = 1, ray: str | None = None) -> None:
        check_workers(count)
        self._pool = _make_pool(cast(Any, factory), count, ray)

    def run(self, jobs: Iterable[Any]) -> Iterator[Any]:
        """The answers, in the jobs' order; jobs are taken a few at a time."""
        return self._pool.run(jobs)

    def close(self) -> None:
        """End all workers."""
        self._pool.close()


def check_workers(count: int) -> None:
    """Check the number of workers.

    Raises:
        MethodError: fewer than one.
    """
    if count < 1:
        raise MethodError(f"--workers must be at least 1, not {count}")


def _make_pool(factory: Any, count: int, ray: str | None) -> Pool:
    if ray is not None:
        from objectflow.runtime.ray_pool import RayActors

        return RayActors(factory, ray, count)
    return InProcess(factory) if count == 1 else Processes(factory, count)
