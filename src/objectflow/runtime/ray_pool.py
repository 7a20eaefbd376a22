"""Scenes made by actors of a Ray cluster, handed on in order."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from typing import Any

from objectflow.errors import DatasetError, MissingExtraError
from objectflow.runtime.pool import in_order
from objectflow.synth.generation.tasks import Maker, MakerFactory, SceneRows, Task

try:
    # Ray changes this variable's meaning with its next version and says so at every start; 0 keeps what it does now.
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
    import ray
except ImportError as error:
    raise MissingExtraError('--ray needs Ray: pip install "objectflow[ray]"') from error

RETRIES = 3
"""How often a scene is tried anew after its node or process was lost. It comes out the same wherever it is made."""


class RayActors:
    """Actors on a Ray cluster; objectflow must be installed on its nodes.

    Args:
        factory: builds a maker in each actor.
        address: of the cluster ("auto", "ray://host:10001", "host:6379"), or "local" to start one on this machine.
        workers: number of actors; None takes one for each CPU of the cluster.
        cuda: share the cluster's GPUs among the actors.

    Raises:
        DatasetError: no cluster at this address.
    """

    def __init__(self, factory: MakerFactory, address: str, workers: int | None = None, *, cuda: bool = False) -> None:
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

    def run(self, tasks: Iterable[Task]) -> Iterator[SceneRows]:
        """The scenes of the tasks, in the tasks' order."""
        return in_order(tasks, list(self._actors), self._send, self._receive)

    def close(self) -> None:
        """End the actors, and the cluster if it was started here."""
        for actor in self._actors.values():
            ray.kill(actor)
        self._actors = {}
        if self._ours:
            ray.shutdown()

    def _send(self, worker: int, task: Task) -> None:
        self._pending[self._actors[worker].make.remote(task)] = worker

    def _receive(self, busy: list[int]) -> tuple[int, SceneRows]:
        ready, _ = ray.wait(list(self._pending), num_returns=1)
        worker = self._pending.pop(ready[0])
        try:
            return worker, ray.get(ready[0])
        except ray.exceptions.RayTaskError as error:
            # Ray wraps what the maker raised; the user shall see the maker's own line.
            raise error.cause from error
        except ray.exceptions.RayActorError as error:
            raise DatasetError(
                f"a Ray actor was lost {RETRIES + 1} times: run the same command again, with fewer --workers"
            ) from error


class _Actor:
    """Keeps one maker, with its renderer, from scene to scene."""

    def __init__(self, factory: MakerFactory) -> None:
        self._factory = factory
        self._maker: Maker | None = None

    def make(self, task: Task) -> SceneRows:
        self._maker = self._maker or self._factory()
        return self._maker(task)
