"""Pairs a second of the generator, each stage's share, and its memory: `python benchmarks/generation.py`.

Everything counts from a scene's number to encoded rows; writing shards is left out. Each worker makes two scenes to
warm up (kernels are compiled on a machine's first run, and loaded on every run) before the clock starts. The seconds
of CPU a pair tell what a machine that is busy with other things would do without them.
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
"""Scenes a worker."""


@dataclasses.dataclass
class Settings:
    """Times the generator on the paper's scenes."""

    scenes: int = 60
    """Scenes that are timed, for each row of the table."""
    workers: int = 2
    """Processes."""
    views: tuple[int, ...] = (1, 4)
    """Pairs taken of one scene."""
    samples: tuple[int, ...] = (1, 4)
    """Colour samples a pixel."""
    lights: tuple[int, int] = (3, 3)
    """Lights with shadows, from and to."""
    memory_scenes: int = 0
    """Make this many scenes in one process too, watch its memory, and print each figure as it comes; 1000 take a
    core five minutes. Pictures are small there: what leaks does so by the scene, not by the pixel."""
    memory_size: tuple[int, int] = (160, 120)
    """Width and height of those pictures."""
    time: bool = True
    """Make the table of times; --no-time leaves memory alone."""
    device: str = "cpu"
    """Where pictures are rendered: cpu or cuda."""
    seed: int = 0
    """Of the scenes."""


@dataclasses.dataclass(frozen=True)
class CountingCpu:
    """A factory whose makers also say how many seconds of CPU a scene took."""

    factory: PaperScenes

    def __call__(self) -> Maker:
        """The maker that counts."""
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
    """Pairs a second, and what was made."""
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
    """(scenes made, resident megabytes) at ten moments, the first after a tenth of the scenes."""
    pool = InProcess(make_factory(settings, 1, 1, settings.memory_size))
    step = max(1, settings.memory_scenes // 10)
    for number, _ in enumerate(pool.run(tasks(0, settings.memory_scenes)), 1):
        if number % step == 0:
            yield number, resident_megabytes()


def resident_megabytes() -> float:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 1e6


def time_all(settings: Settings) -> Table:
    """A row for each number of views and of samples."""
    table = Table(box=None, pad_edge=False, header_style="bold")
    for name in ("samples", "views", "pairs/s", "CPU s a pair", "pairs"):
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
