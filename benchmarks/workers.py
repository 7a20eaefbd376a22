"""Seconds of `objectflow run` with one and with two workers: `python benchmarks/workers.py`.

The recording is the one of `live.py`, written as a folder of numbered frames. Each run is a process of its own, with
one thread per process. The table has the wall time and the CPU time of the main process and of its workers. Wall times
are valid on a machine with a free core for each process. CPU times depend less on the load of the machine, so the last
lines compute from them what a quiet machine reaches: a run of the fewest pairs stands for start-up, and the rest is
divided by the pairs. Alone, a pair takes the time of the main thread, since files are written beside it. With W
workers, it takes the larger of the main thread's time and a worker's time divided by W; on two cores it also takes at
least half of all time together.
"""

from __future__ import annotations

import dataclasses
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import cv2
import tyro
from rich.console import Console
from rich.table import Table

from live import Recording

FEWEST = 2
"""Pairs of the run that stands for start-up."""
_RUN = """
import json, resource, sys, time
from objectflow.cli import main
code = main(sys.argv[1:])
use = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
print(json.dumps([code, time.thread_time(), *(one.ru_utime + one.ru_stime for one in use)]), file=sys.stderr)
"""


@dataclasses.dataclass
class Settings:
    """Times runs of a recording of 640x480."""

    method: str = "rigidmatch"
    """Method by name."""
    pairs: int = 16
    """Pairs of the recording."""
    width: int = 640
    """Width of the images, pixels."""
    workers: int = 2
    """Workers that are compared with none."""
    pictures: bool = True
    """Write pictures."""


@dataclasses.dataclass(frozen=True)
class Seconds:
    """Wall time of a run, and CPU time of its main thread, of its main process and of its workers."""

    wall: float
    thread: float
    main: float
    workers: float

    def per_pair(self, start: Seconds, pairs: int) -> Seconds:
        """What each further pair took beyond a run of `FEWEST` pairs."""
        return Seconds(
            *(
                (one - other) / (pairs - FEWEST)
                for one, other in zip(dataclasses.astuple(self), dataclasses.astuple(start), strict=True)
            )
        )


def write_recording(folder: Path, width: int, count: int) -> None:
    """Every tenth frame of the recording as a folder of numbered images."""
    recording = Recording(width, 10 * count)
    for kind in ("color", "depth"):
        (folder / kind).mkdir(parents=True)
    for number in range(count):
        frame = recording[10 * number]
        cv2.imwrite(str(folder / "color" / f"{number:06d}.png"), frame.color[..., ::-1])
        cv2.imwrite(str(folder / "depth" / f"{number:06d}.png"), (1000 * frame.depth).astype("uint16"))


def time_run(source: Path, out: Path, settings: Settings, workers: int, pairs: int) -> Seconds:
    """One run in a process of its own."""
    camera = Recording(settings.width, 1).camera
    words = ["run", str(source), "--out", str(out), "--method", settings.method, "--limit", str(pairs)]
    words += ["--intrinsics", f"{camera.fx},{camera.fy},{camera.cx},{camera.cy}", "--depth-scale", "1000"]
    words += ["--workers", str(workers), *([] if settings.pictures else ["--no-pictures"])]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    start = time.perf_counter()
    done = subprocess.run(
        [sys.executable, "-c", _RUN, *words], env=environment, capture_output=True, text=True, check=True
    )
    wall = time.perf_counter() - start
    code, thread, main, children = json.loads(done.stderr.splitlines()[-1])
    if code:
        raise RuntimeError(done.stderr)
    return Seconds(wall, thread, main, children)


def main(settings: Settings) -> None:
    """Measure, print."""
    table = Table(title=f"objectflow run, {settings.method}, {settings.pairs} pairs")
    for name in ("workers", "pairs", "wall s", "CPU s, main thread", "main process", "workers"):
        table.add_column(name, justify="right")
    found: dict[tuple[int, int], Seconds] = {}
    with tempfile.TemporaryDirectory() as folder:
        source = Path(folder) / "recording"
        write_recording(source, settings.width, settings.pairs + 1)
        for workers in (1, settings.workers):
            for pairs in (FEWEST, settings.pairs):
                seconds = time_run(source, Path(folder) / f"out{workers}-{pairs}", settings, workers, pairs)
                found[workers, pairs] = seconds
                columns = dataclasses.astuple(seconds)
                table.add_row(str(workers), str(pairs), *(f"{value:.1f}" for value in columns))
    console = Console(width=110)
    console.print(table)
    alone, side = (
        found[workers, settings.pairs].per_pair(found[workers, FEWEST], settings.pairs)
        for workers in (1, settings.workers)
    )
    free = max(side.thread, side.workers / settings.workers)
    two = max(free, (side.main + side.workers) / 2)
    console.print(f"CPU s per pair: alone {alone.thread:.2f} in the main thread and {alone.main:.2f} in all;", end=" ")
    console.print(f"with workers {side.thread:.2f} and {side.main:.2f}, beside {side.workers:.2f} in the workers")
    console.print(f"computed speed-up: {alone.thread / free:.2f} with a core for each process,", end=" ")
    console.print(f"{alone.thread / two:.2f} on two cores; measured, per pair: {alone.wall / side.wall:.2f}")


if __name__ == "__main__":
    main(tyro.cli(Settings))
