"""Where a training step's time goes: waiting for data, augmentation and targets, forward, backward and update.

    python benchmarks/training.py DATA [--recipe cpu] [--steps 20] [--device auto] [a recipe's fields]

Data are measured twice: in the first pass, when rows are decoded, and later, when they are kept.
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

from objectflow.dataset.batches import CACHE_BYTES, Batches
from objectflow.dataset.shards import open_pairs
from objectflow.runtime.devices import find_device
from objectflow.training.adapters import losses_of, trained_form
from objectflow.training.ema import ExponentialMovingAverage
from objectflow.training.parallel import Process
from objectflow.training.prefetch import on_device
from objectflow.training.recipe import RECIPES, Recipe, find_recipe
from objectflow.training.setup import build_network, build_optimizer, compiled, precision
from objectflow.training.step import prepare, step_generator

PHASES = ("data", "targets", "forward", "backward", "update")
"""Targets with augmentation and sensor noise before them, forward with the losses."""


class Clock:
    """Wall-clock seconds by phase; a GPU is waited for at each phase's end."""

    def __init__(self, device: torch.device) -> None:
        self.device, self.seconds = device, dict.fromkeys(PHASES, 0.0)

    @contextlib.contextmanager
    def phase(self, name: str) -> Iterator[None]:
        """Time what happens inside."""
        start = time.perf_counter()
        yield
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)
        self.seconds[name] += time.perf_counter() - start


def measure(
    recipe: Recipe, batches: Batches, device: torch.device, steps: int, warm_up: int
) -> tuple[dict[str, float], float]:
    """Seconds by phase over `steps` steps after `warm_up` more, and CPU seconds of this process a step."""
    alone = Process(0, 1, device)
    network = build_network(recipe, alone, backbone=None, start=None)
    optimizer = build_optimizer(recipe, network, device)
    mean = ExponentialMovingAverage(network, recipe.ema_decay) if recipe.ema_decay else None
    feed = on_device(batches.iterate(), device)
    trial = prepare(next(feed), recipe, step_generator(0, 0, 0, device))
    forward = compiled(trained_form(network), recipe, trial.images, device, print)
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
            losses = losses_of(output, prepared, recipe)
        with clock.phase("backward"):
            optimizer.zero_grad(set_to_none=True)
            losses["total"].backward()  # type: ignore[no-untyped-call]
        with clock.phase("update"):
            clip_grad_norm_(network.parameters(), recipe.clip or float("inf"))
            optimizer.step()
            if mean is not None:
                mean.update()
    return clock.seconds, (_cpu_seconds() - used) / steps


@dataclasses.dataclass(frozen=True)
class Settings:
    """Times training steps."""

    data: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="DATA")]
    """Folder of a data set with the split train."""
    recipe: str = "cpu"
    """paper, gpu or cpu; every field of it is an option too."""
    timed: int = 20
    """Steps that are timed."""
    device: str = "auto"
    """auto, cpu, cuda or cuda:N."""
    fields: Annotated[Recipe, tyro.conf.arg(name="")] = RECIPES["cpu"]


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
            "rows kept" if kept else "rows decoded",
            f"{settings.batch_size * steps / total:.1f}",
            f"{1000 * total / steps:.0f}",
            f"{1000 * cpu:.0f}",
            *(f"{100 * value / total:.1f}" for value in seconds.values()),
        )
    console.print(
        f"recipe {arguments.recipe}, {settings.method}, batch {settings.batch_size}, "
        f"{settings.size[1]}x{settings.size[0]}, "
        f"{settings.precision}, {torch.get_num_threads()} threads, {settings.workers} workers, {place}"
    )
    console.print(table)


def _cpu_seconds() -> float:
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


if __name__ == "__main__":
    words = sys.argv[1:]
    name = words[words.index("--recipe") + 1] if "--recipe" in words[:-1] else "cpu"
    run(tyro.cli(Settings, default=Settings(data=tyro.MISSING, recipe=name, fields=find_recipe(name))))
