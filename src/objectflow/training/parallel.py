"""One run in several processes: this process's rank, from torchrun's environment, and their communication."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, TypeVar

import torch
import torch.distributed as dist
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel

from objectflow.errors import TrainingError
from objectflow.runtime.devices import find_device

T = TypeVar("T")


@dataclass(frozen=True)
class Process:
    """A process of the run.

    Attributes:
        rank, world_size: its number, and the number of processes; 0 and 1 without torchrun.
        device: where it computes.
    """

    rank: int
    world_size: int
    device: torch.device

    @property
    def first(self) -> bool:
        """Whether this process writes and prints."""
        return self.rank == 0

    def shared(self, network: nn.Module) -> nn.Module:
        """The network with its gradients averaged over all processes."""
        if self.world_size == 1:
            return network
        devices = [self.device] if self.device.type == "cuda" else None
        # Buffers are the running statistics of batch normalisation; synchronised normalisation keeps them equal.
        return DistributedDataParallel(network, device_ids=devices, broadcast_buffers=self.device.type != "cuda")

    def mean(self, values: Tensor) -> Tensor:
        """The mean over all processes."""
        return values if self.world_size == 1 else self._reduced(values, dist.ReduceOp.SUM) / self.world_size

    def largest(self, value: float) -> float:
        """The maximum over all processes, so that a signal to one stops all."""
        if self.world_size == 1:
            return value
        tensor = torch.tensor([value], dtype=torch.float64, device=self.device)
        return float(self._reduced(tensor, dist.ReduceOp.MAX))

    def gathered(self, value: T) -> list[T]:
        """The values of all processes, in order of rank."""
        if self.world_size == 1:
            return [value]
        values: list[Any] = [None] * self.world_size
        dist.all_gather_object(values, value)
        return values

    def wait(self) -> None:
        """Wait until all processes have arrived here."""
        if self.world_size > 1:
            dist.barrier()

    def _reduced(self, values: Tensor, how: dist.ReduceOp.RedOpType) -> Tensor:
        values = values.detach().clone()
        dist.all_reduce(values, op=how)
        return values


def synchronize_batch_norm(network: nn.Module, process: Process) -> None:
    """Replace batch normalisation inside a network by one over the joint batch, on CUDA; tensors keep their names."""
    if process.world_size > 1 and process.device.type == "cuda":
        nn.SyncBatchNorm.convert_sync_batchnorm(network)  # type: ignore[no-untyped-call]


def is_first() -> bool:
    """Whether this process writes and prints; known before the run is joined."""
    return os.environ.get("RANK", "0") == "0"


@contextmanager
def joined(device: str) -> Iterator[Process]:
    """Join the run that torchrun's environment describes, and leave it at the end; a single process without it.

    Args:
        device: "auto", "cpu", "cuda" or "cuda:N"; under torchrun, "cuda" is the device with this process's local rank.

    Raises:
        TrainingError: an environment that describes no run.
        MethodError: no such device.
    """
    if "WORLD_SIZE" not in os.environ:
        yield Process(0, 1, find_device(device))
        return
    try:
        rank, world_size = int(os.environ["RANK"]), int(os.environ["WORLD_SIZE"])
        local = int(os.environ.get("LOCAL_RANK", "0"))
    except (KeyError, ValueError) as error:
        raise TrainingError(f"WORLD_SIZE is set, but {error} is not as torchrun sets it: use torchrun") from None
    place = find_device(device)
    if place.type == "cuda" and device in ("auto", "cuda"):
        place = find_device(f"cuda:{local}")
        torch.cuda.set_device(place)
    if world_size == 1:
        yield Process(0, 1, place)
        return
    dist.init_process_group("nccl" if place.type == "cuda" else "gloo", rank=rank, world_size=world_size)
    try:
        yield Process(rank, world_size, place)
    finally:
        dist.destroy_process_group()
