"""A worker pool of actors on a Ray cluster."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from typing import Any, Generic

from objectflow.errors import DatasetError, MissingExtraError
from objectflow.runtime.pool import Job, Result, in_order

try:
    # The next version of Ray changes the meaning of this variable and warns at every start; 0 keeps the present one.
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
    import ray
except ImportError as error:
    raise MissingExtraError("--ray needs Ray", "ray") from error

RETRIES = 3
"""Number of times a job is repeated after its node or process was lost; results do not depend on where it runs."""


class RayActors(Generic[Job, Result]):
    """Actors on a Ray cluster; objectflow must be installed on its nodes.

    Args:
        factory: builds, inside each actor, the function that runs jobs; picklable.
        address: of the cluster ("auto", "ray://host:10001", "host:6379"), or "local" to start one on this machine.
        workers: number of actors; None takes one per CPU of the cluster.
        cuda: share the cluster's GPUs among the actors.

    Raises:
        DatasetError: no cluster at this address.
    """

    def __init__(
        self,
        factory: Callable[[], Callable[[Job], Result]],
        address: str,
        workers: int | None = None,
        *,
        cuda: bool = False,
    ) -> None:
        self._ours = not ray.is_initialized()
        if self._ours:
            options: dict[str, Any] = {"num_cpus": workers} if address == "local" else {"address": address}
            try:
                ray.init(logging_level="error", log_to_driver=False, include_dashboard=False, **options)
            except (ConnectionError, ValueError, RuntimeError) as error:
                reason = str(error).splitlines()[0]
                raise DatasetError(f"--ray {address}: no Ray cluster there: {reason}") from error
        resources = ray.cluster_resources()
        count = workers or max(1, int(resources.get("CPU", 1)))
        gpus = min(1.0, resources.get("GPU", 0) / count) if cuda else 0
        actor = ray.remote(num_cpus=1, num_gpus=gpus, max_restarts=RETRIES, max_task_retries=RETRIES)(_Actor)
        self._actors = {i: actor.remote(factory) for i in range(count)}
        self._pending: dict[Any, int] = {}

    def run(self, jobs: Iterable[Job]) -> Iterator[Result]:
        """See `Pool`.

        Raises:
            DatasetError: an actor was lost more than `RETRIES` times.
        """
        return in_order(jobs, list(self._actors), self._send, self._receive)

    def close(self) -> None:
        """End the actors, and the cluster if it was started here."""
        for actor in self._actors.values():
            ray.kill(actor)
        self._actors = {}
        if self._ours:
            ray.shutdown()

    def _send(self, worker: int, job: Job) -> None:
        self._pending[self._actors[worker].run.remote(job)] = worker

    def _receive(self, busy: list[int]) -> tuple[int, Result]:
        ready, _ = ray.wait(list(self._pending), num_returns=1)
        worker = self._pending.pop(ready[0])
        try:
            return worker, ray.get(ready[0])
        except ray.exceptions.RayTaskError as error:
            # Ray wraps the exception of the job; the user needs the original message.
            raise error.cause from error
        except ray.exceptions.RayActorError as error:
            raise DatasetError(
                f"a Ray actor was lost {RETRIES + 1} times: run the same command again, with fewer --workers"
            ) from error


class _Actor:
    """Keeps the function that runs jobs, with all that it has loaded, from job to job."""

    def __init__(self, factory: Callable[[], Callable[[Any], Any]]) -> None:
        self._factory = factory
        self._function: Callable[[Any], Any] | None = None

    def run(self, job: Any) -> Any:
        self._function = self._function or self._factory()
        return self._function(job)
