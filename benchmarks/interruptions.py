"""The same bytes with any workers, with Ray, and after kills at random times: `python benchmarks/interruptions.py`.

Every run is `objectflow generate` in its own process group, with small shards, so that only some are finished when it
is killed (SIGKILL to the whole group, including workers). All data sets are compared file by file with that of an
uninterrupted run with one worker. The exit status is 1 if any byte or file name differs.
"""

from __future__ import annotations

import dataclasses
import importlib.util
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import tyro

PROGRAM = (
    "import sys; import objectflow.synth.generation.jobs as jobs; jobs.ROWS_A_SHARD = int(sys.argv.pop(1)); "
    "from objectflow.cli import main; sys.exit(main())"
)


@dataclasses.dataclass
class Settings:
    """Generates one small data set in several ways."""

    pairs: int = 24
    """Number of pairs."""
    rows_a_shard: int = 3
    """Pairs per shard."""
    kills: int = 10
    """Number of kills."""
    preset: str = "small"
    """paper, small or clutter."""
    samples: int = 1
    """Number of colour samples per pixel, 1 or 4."""
    seed: int = 0
    """Random seed of the data set and of the times of the kills."""


def start(settings: Settings, out: Path, *options: str) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-c", PROGRAM, str(settings.rows_a_shard), "generate", "--out", str(out)]
    command += ["--pairs", str(settings.pairs), "--preset", settings.preset, "--samples", str(settings.samples)]
    command += ["--seed", str(settings.seed), *options]
    return subprocess.Popen(command, start_new_session=True, stdout=subprocess.DEVNULL)


def finish(settings: Settings, out: Path, *options: str) -> float:
    """Run to the end; returns the seconds."""
    begin = time.perf_counter()
    if start(settings, out, *options).wait() != 0:
        sys.exit(f"generate {' '.join(options)} failed")
    return time.perf_counter() - begin


def kill(process: subprocess.Popen[bytes], after: float) -> bool:
    """Kill a run and its workers after some seconds; False if it ended before."""
    try:
        process.wait(timeout=after)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        return True
    if process.returncode != 0:
        sys.exit(f"a continued run ended with {process.returncode}")
    return False


def content(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def same(name: str, folder: Path, reference: dict[str, bytes]) -> bool:
    found = content(folder)
    different = sorted(file for file in {*found, *reference} if found.get(file) != reference.get(file))
    print(f"{name}: {'the same bytes' if not different else f'differs in {different}'}", flush=True)
    return not different


def killed(settings: Settings, out: Path, whole: float) -> tuple[list[int], int]:
    """Kill and continue a run until the number of kills is reached, then let it finish.

    Returns:
        The number of finished shards at each kill, and the number of data sets that were finished between kills.
    """
    times = random.Random(settings.seed)
    shards: list[int] = []
    finished = 0
    while len(shards) < settings.kills:
        # The first seconds of a run are spent on imports; most kills should come later.
        if kill(start(settings, out, "--workers", "2"), whole * times.uniform(0.2, 1.0)):
            shards.append(len(list(out.glob("*.parquet"))))
        else:
            finished += 1
            shutil.rmtree(out)
    finish(settings, out, "--workers", "2")
    return shards, finished


def main(settings: Settings) -> None:
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        finish(settings, folder / "one", "--workers", "1")
        reference = content(folder / "one")
        print(f"1 worker: {len(reference)} files, {sum(map(len, reference.values()))} bytes", flush=True)
        whole = finish(settings, folder / "two", "--workers", "2")
        equal = same("2 workers", folder / "two", reference)
        if importlib.util.find_spec("ray"):
            finish(settings, folder / "ray", "--ray", "local", "--workers", "2")
            equal &= same("Ray, 2 actors", folder / "ray", reference)
        else:
            print("Ray is not installed: left out")
        shards, finished = killed(settings, folder / "killed", whole)
        print(f"finished shards at each kill: {shards}; data sets finished between kills: {finished}")
        equal &= same(f"killed {len(shards)} times and continued", folder / "killed", reference)
    sys.exit(0 if equal else 1)


if __name__ == "__main__":
    main(tyro.cli(Settings, description=__doc__))
