"""CPU time per training pair outside the network: `python benchmarks/feeding.py --data DIR`.

CPU milliseconds of one core per pair for each step from the stored row to the loss, and for a narrow network as scale.
"""

from __future__ import annotations

import dataclasses
import time
from collections import defaultdict
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TypeVar

import torch
import tyro
from rich.console import Console
from rich.table import Table

from objectflow.dataset.augment import AugmentSettings, augment, network_inputs
from objectflow.dataset.batches import Batches
from objectflow.dataset.shards import open_pairs
from objectflow.dataset.targets import make_targets
from objectflow.networks import NetworkSettings, SceneFlowNet
from objectflow.training.sceneflownet_losses import sceneflownet_losses

T = TypeVar("T")


@dataclasses.dataclass
class Settings:
    """Measures reading, augmentation, targets and losses."""

    data: Path
    """Folder of a data set; 64 pairs are enough."""
    split: str = "train"
    """Split of the data set."""
    sizes: tuple[tuple[int, int], ...] = ((120, 160), (240, 320))
    """Heights and widths of images."""
    batch_size: int = 8
    """Pairs per step."""
    steps: int = 6
    """Number of steps to measure, after one for warm-up."""
    width: float = 0.25
    """Widths of the network relative to the paper's."""


def main(settings: Settings) -> None:
    torch.set_num_threads(1)
    table = Table(title=f"CPU ms per pair, one core, batches of {settings.batch_size}, torch {torch.__version__}")
    table.add_column("step")
    columns = [measure(size, settings) for size in settings.sizes]
    for height, width in settings.sizes:
        table.add_column(f"{width}x{height}", justify="right")
    for name in columns[0]:
        table.add_row(name, *(f"{column[name]:.2f}" for column in columns))
    Console().print(table)


def measure(size: tuple[int, int], settings: Settings) -> dict[str, float]:
    spent: dict[str, float] = defaultdict(float)
    shards = open_pairs(settings.data, settings.split)
    options = AugmentSettings()
    generator = torch.Generator().manual_seed(0)
    network = SceneFlowNet(NetworkSettings().scaled(settings.width), generator=generator)

    def clock(name: str, work: Callable[[], T]) -> T:
        start = time.process_time()
        result = work()
        spent[name] += time.process_time() - start
        return result

    fresh = Batches(shards, settings.batch_size, size=size, seed=0, cache_bytes=0).iterate()
    kept_source = Batches(shards, settings.batch_size, size=size, seed=0)
    kept = kept_source.iterate()
    for _ in range(kept_source.steps_per_pass):
        next(kept)
    for step in range(settings.steps + 1):
        clock("read and decode, first time", lambda: next(fresh))
        batch = clock("read, cached", lambda: next(kept))
        batch = clock("augment", partial(augment, batch, options, generator))
        inputs = clock("sensor noise, points", partial(network_inputs, batch, options, generator))
        points = inputs.exact_points
        targets = clock("targets", partial(make_targets, batch.table, batch.curr_labels, points))
        output = clock(f"network x {settings.width:g}, forward", partial(network, *inputs[:4]))
        loss = clock("losses", partial(sceneflownet_losses, output, targets, points))["total"]
        clock("backward", loss.backward)
        if step == 0:
            spent.clear()
    return {name: 1e3 * seconds / settings.steps / settings.batch_size for name, seconds in spent.items()}


if __name__ == "__main__":
    main(tyro.cli(Settings, description=Settings.__doc__))
