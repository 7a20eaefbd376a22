"""Time of the parts of a training step: waiting for data, augmentation and targets, forward, backward and update.

    python benchmarks/training.py DATA [--recipe cpu] [--variant c-vl] [--timed 20] [fields of the recipe]

The time for data is measured twice: in the first pass, which decodes rows, and later, when decoded rows are cached.
"""

from __future__ import annotations

import contextlib
import dataclasses
import resource
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import torch
import tyro
from rich.console import Console
from rich.table import Table
from torch.nn.utils import clip_grad_norm_

from objectflow.cli.train import default
from objectflow.dataset.batches import CACHE_BYTES, Batches
from objectflow.dataset.shards import open_pairs
from objectflow.runtime.devices import find_device
from objectflow.training.ema import ExponentialMovingAverage
from objectflow.training.model_config import Variant
from objectflow.training.parallel import Process
from objectflow.training.prefetch import on_device
from objectflow.training.recipe import Recipe
from objectflow.training.recipes import RECIPES
from objectflow.training.setup import build_adapter, build_optimizer, compiled, precision
from objectflow.training.step import prepare, step_generator

PHASES = ("data", "targets", "forward", "backward", "update")
"""Parts of a step; targets include augmentation and sensor noise, forward includes the losses."""


class Clock:
    """Wall-clock seconds by phase; a GPU is synchronised at the end of each phase."""

    def __init__(self, device: torch.device) -> None:
        self.device, self.seconds = device, dict.fromkeys(PHASES, 0.0)

    @contextlib.contextmanager
    def phase(self, name: str) -> Iterator[None]:
        """Add the time of the block to a phase."""
        start = time.perf_counter()
        yield
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)
        self.seconds[name] += time.perf_counter() - start


def measure(
    recipe: Recipe, batches: Batches, device: torch.device, steps: int, warm_up: int
) -> tuple[dict[str, float], float]:
    """Seconds by phase over `steps` steps after `warm_up` others, and CPU seconds of this process per step."""
    alone = Process(0, 1, device)
    adapter = build_adapter(recipe, alone, backbone=None, start=None)
    optimizer = build_optimizer(recipe, adapter.network, device)
    average = ExponentialMovingAverage(adapter, recipe.ema_decay) if recipe.ema_decay else None
    feed = on_device(batches.iterate(), device)
    trial = prepare(next(feed), recipe, step_generator(0, 0, 0, device))
    forward = compiled(adapter.module, recipe, trial.images, device, print)
    clock, used = Clock(device), 0.0
    for step in range(warm_up + steps):
        if step == warm_up:
            clock, used = Clock(device), _cpu_seconds()
        with clock.phase("data"):
            batch = next(feed)
        with clock.phase("targets"):
            prepared = prepare(batch, recipe, step_generator(0, step, 0, device))
        with clock.phase("forward"):
            with precision(recipe, device):
                output = forward(*prepared.images)
            losses = adapter.losses(output, prepared)
        with clock.phase("backward"):
            optimizer.zero_grad(set_to_none=True)
            losses["total"].backward()  # type: ignore[no-untyped-call]
        with clock.phase("update"):
            clip_grad_norm_(adapter.network.parameters(), recipe.clip or float("inf"))
            optimizer.step()
            if average is not None:
                average.update()
    return clock.seconds, (_cpu_seconds() - used) / steps


@dataclasses.dataclass(frozen=True)
class Settings:
    """Measures training steps."""

    data: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="DATA")]
    """Folder of a data set with the split train."""
    recipe: str = "cpu"
    """paper, gpu or cpu; every field of it is an option too."""
    variant: Variant = "c-vl"
    """The network and its losses."""
    timed: int = 20
    """Number of steps to measure."""
    device: str = "auto"
    """auto, cpu, cuda or cuda:N."""
    fields: Annotated[Recipe, tyro.conf.arg(name=""), tyro.conf.AvoidSubcommands] = RECIPES["cpu"]


def run(arguments: Settings) -> None:
    settings, steps = arguments.fields, arguments.timed
    place, console = find_device(arguments.device), Console(highlight=False)
    shards = open_pairs(arguments.data)
    table = Table(box=None, pad_edge=False, header_style="bold")
    for name in ("", "pairs/s", "ms/step", "CPU ms", *(f"{phase} %" for phase in PHASES)):
        table.add_column(name, justify="left" if not name else "right")
    for kept in (False, True):
        batches = Batches(
            shards,
            settings.batch_size,
            size=settings.size,
            seed=0,
            workers=settings.workers,
            cache_bytes=CACHE_BYTES if kept else 0,
        )
        warm_up = min(batches.steps_per_pass, 200) if kept else 2
        seconds, cpu = measure(settings, batches, place, steps, warm_up)
        total = sum(seconds.values())
        table.add_row(
            "rows cached" if kept else "rows decoded",
            f"{settings.batch_size * steps / total:.1f}",
            f"{1000 * total / steps:.0f}",
            f"{1000 * cpu:.0f}",
            *(f"{100 * value / total:.1f}" for value in seconds.values()),
        )
    console.print(
        f"recipe {arguments.recipe}, {settings.model.method}, batch {settings.batch_size}, "
        f"{settings.size[1]}x{settings.size[0]}, "
        f"{settings.precision}, {torch.get_num_threads()} threads, {settings.workers} workers, {place}"
    )
    console.print(table)


def _cpu_seconds() -> float:
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


if __name__ == "__main__":
    typed = default(sys.argv[1:])
    start = Settings(tyro.MISSING, recipe=typed.recipe, variant=typed.variant, fields=typed.settings)
    run(tyro.cli(Settings, default=start))
