"""Seconds a pair and peak memory of each method, beside `dense-flow` in the same run: `python benchmarks/latency.py`.

The pairs are the tests' analytic scenes, 1-6 moving objects each, at each size. Every method runs in a process of its
own, so that its peak memory is its own.
"""

from __future__ import annotations

import dataclasses
import multiprocessing
import os
import platform
import resource
import statistics
import sys
import time
from pathlib import Path

import tyro
from rich.console import Console
from rich.table import Table

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

REFERENCE = "dense-flow"


@dataclasses.dataclass
class Settings:
    """Times methods on analytic pairs."""

    methods: tuple[str, ...] = ("consensus", "zero")
    """Methods by name; `dense-flow` is always timed for the ratio."""
    sizes: tuple[int, ...] = (320, 640)
    """Image widths; heights are three quarters of them."""
    pairs: int = 12
    """Scenes for each size."""
    repeats: int = 2
    """Runs of each scene; the faster one counts."""


def measure(
    method: str, width: int, pairs: int, repeats: int, queue: multiprocessing.Queue[tuple[float, ...]]
) -> None:
    import analytic
    import objectflow

    scenes = [analytic.make_scene(1000 + seed, width=width, height=width * 3 // 4) for seed in range(pairs)]
    estimator = objectflow.load(method)
    estimator(scenes[0].prev, scenes[0].curr)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    seconds = []
    for scene in scenes:
        runs = []
        for _ in range(repeats):
            start = time.perf_counter()
            estimator(scene.prev, scene.curr)
            runs.append(time.perf_counter() - start)
        seconds.append(min(runs))
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    queue.put((statistics.median(seconds), max(seconds), max(before, peak) / 1024))


def main(settings: Settings) -> None:
    context = multiprocessing.get_context("spawn")
    table = Table(title=f"{os.cpu_count()} cores, {platform.machine()}, Python {platform.python_version()}")
    for column in ("method", "size", "median s", "slowest s", f"times {REFERENCE}", "peak MiB"):
        table.add_column(column, justify="left" if column == "method" else "right")
    for width in settings.sizes:
        rows = {}
        for method in dict.fromkeys((REFERENCE, *settings.methods)):
            queue: multiprocessing.Queue[tuple[float, ...]] = context.Queue()
            process = context.Process(target=measure, args=(method, width, settings.pairs, settings.repeats, queue))
            process.start()
            rows[method] = queue.get()
            process.join()
        for method, (median, slowest, peak) in rows.items():
            ratio = median / rows[REFERENCE][0]
            size = f"{width}x{width * 3 // 4}"
            table.add_row(method, size, f"{median:.3f}", f"{slowest:.3f}", f"{ratio:.2f}", f"{peak:.0f}")
    Console(width=110).print(table)


if __name__ == "__main__":
    main(tyro.cli(Settings))
