"""Speed of the generator in pairs per second, the share of each stage, and memory: `python benchmarks/generation.py`.

The time from a scene's number to its encoded rows is measured, without the writing of shards. Each worker first makes
two unmeasured scenes (kernels are compiled on a machine's first run, and loaded on every run). CPU seconds per pair do
not depend on other load of the machine.
"""

from __future__ import annotations

import dataclasses
import os
import platform
import resource
import time
from collections.abc import Iterator
from pathlib import Path

import tyro
from rich.console import Console
from rich.table import Table

from objectflow.runtime.pool import InProcess, Processes
from objectflow.synth.generation.paper_maker import PaperScenes
from objectflow.synth.generation.tasks import Maker, SceneRows, Task
from objectflow.synth.scenes.paper_scene import SceneSettings

WARM_UP = 2
"""Number of unmeasured scenes per worker."""


@dataclasses.dataclass
class Settings:
    """Measures the generator on the paper's scenes."""

    scenes: int = 60
    """Number of measured scenes per row of the table."""
    workers: int = 2
    """Number of processes."""
    views: tuple[int, ...] = (1, 4)
    """Number of pairs per scene."""
    samples: tuple[int, ...] = (1, 4)
    """Number of colour samples per pixel."""
    lights: tuple[int, int] = (3, 3)
    """Minimum and maximum number of lights."""
    memory_scenes: int = 0
    """Number of scenes for the measurement of memory in one process; 1000 take five minutes on one core. Images are
    small, because leaks are per scene, not per pixel."""
    memory_size: tuple[int, int] = (160, 120)
    """Width and height of the images in the measurement of memory, pixels."""
    time: bool = True
    """Measure times; --no-time measures memory only."""
    device: str = "cpu"
    """Device for rendering: cpu or cuda."""
    seed: int = 0
    """Random seed."""


@dataclasses.dataclass(frozen=True)
class CountingCpu:
    """A factory whose makers also measure the CPU seconds of each scene."""

    factory: PaperScenes

    def __call__(self) -> Maker:
        """Return the measuring maker."""
        maker = self.factory()

        def make(task: Task) -> SceneRows:
            start = time.process_time()
            made = maker(task)
            return dataclasses.replace(made, seconds={**made.seconds, "cpu": time.process_time() - start})

        return make


def tasks(first: int, count: int) -> Iterator[Task]:
    return (Task("pairs", scene) for scene in range(first, first + count))


def make_factory(settings: Settings, samples: int, views: int, size: tuple[int, int] = (320, 240)) -> PaperScenes:
    return PaperScenes(
        seed=settings.seed,
        split="train",
        settings=SceneSettings(lights=settings.lights, width=size[0], height=size[1]),
        views=views,
        samples=samples,
        device="cuda" if settings.device == "cuda" else "cpu",
    )


def time_scenes(settings: Settings, samples: int, views: int) -> tuple[float, list[SceneRows]]:
    """Pairs per second, and the scenes that were made."""
    pool = Processes(CountingCpu(make_factory(settings, samples, views)), settings.workers)
    try:
        warm_up = WARM_UP * settings.workers
        for _ in pool.run(tasks(settings.scenes, warm_up)):
            pass
        start = time.perf_counter()
        made = list(pool.run(tasks(0, settings.scenes)))
        seconds = time.perf_counter() - start
    finally:
        pool.close()
    return sum(len(scene.rows) for scene in made) / seconds, made


def watch_memory(settings: Settings) -> Iterator[tuple[int, float]]:
    """(number of scenes, resident megabytes) after each tenth of the scenes."""
    pool = InProcess(make_factory(settings, 1, 1, settings.memory_size))
    step = max(1, settings.memory_scenes // 10)
    for number, _ in enumerate(pool.run(tasks(0, settings.memory_scenes)), 1):
        if number % step == 0:
            yield number, resident_megabytes()


def resident_megabytes() -> float:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 1e6


def time_all(settings: Settings) -> Table:
    """A table with a row for each number of views and samples."""
    table = Table(box=None, pad_edge=False, header_style="bold")
    for name in ("samples", "views", "pairs/s", "CPU s/pair", "pairs"):
        table.add_column(name, justify="right")
    table.add_column("share of the time")
    for views in settings.views:
        for samples in settings.samples:
            rate, made = time_scenes(settings, samples, views)
            spent: dict[str, float] = {}
            for scene in made:
                for stage, seconds in scene.seconds.items():
                    spent[stage] = spent.get(stage, 0.0) + seconds
            cpu, rows = spent.pop("cpu"), sum(len(scene.rows) for scene in made)
            total = sum(spent.values())
            shares = ", ".join(f"{stage} {100 * seconds / total:.0f}%" for stage, seconds in spent.items())
            table.add_row(str(samples), str(views), f"{rate:.2f}", f"{cpu / rows:.2f}", str(rows), shares)
    return table


def main() -> None:
    settings = tyro.cli(Settings, description=__doc__)
    console = Console(highlight=False, width=120)
    console.print(f"{platform.machine()}, {os.cpu_count()} cores, {settings.workers} workers, {settings.device}")
    if settings.time:
        console.print(time_all(settings))
    seen = []
    for number, size in watch_memory(settings) if settings.memory_scenes else ():
        seen.append(size)
        console.print(f"after {number} scenes: {size:.0f} MB resident, {size / seen[0]:.3f} of the first")


if __name__ == "__main__":
    main()
