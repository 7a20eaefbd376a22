"""Worker pools for the options `--workers` and `--ray`."""

from __future__ import annotations

from collections.abc import Callable

from objectflow.errors import MethodError
from objectflow.runtime.pool import InProcess, Job, Pool, Processes, Result


def make_pool(
    factory: Callable[[], Callable[[Job], Result]], workers: int = 1, ray: str | None = None
) -> Pool[Job, Result]:
    """Start a pool of workers.

    Args:
        factory: builds, inside each worker, the function that runs jobs; picklable.
        workers: number of workers; 1 without Ray is the calling process.
        ray: address of a Ray cluster, "local" for a new one on this machine, None for no cluster.

    Raises:
        MethodError: fewer than one worker.
        DatasetError: no cluster at this address.
        MissingExtraError: Ray is not installed.
    """
    check_workers(workers)
    if ray is not None:
        from objectflow.runtime.ray_pool import RayActors

        return RayActors(factory, ray, workers)
    return InProcess(factory) if workers == 1 else Processes(factory, workers)


def check_workers(count: int) -> None:
    """Check the number of workers.

    Raises:
        MethodError: fewer than one.
    """
    if count < 1:
        raise MethodError(f"--workers must be at least 1, not {count}")
