"""The generator's bytes: with any workers, with Ray, killed at random moments: `python benchmarks/interruptions.py`.

Every run is `objectflow generate` in a process group of its own, with small shards, so that some are finished and
some are not when it is killed (SIGKILL to the whole group, workers included). The data set that one worker makes
undisturbed is compared with all others, file by file. Ends with status 1 where any byte or any file's name differs.
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
    "import sys; import objectflow.synth.generation.generate as g; g.ROWS_A_SHARD = int(sys.argv.pop(1)); "
    "from objectflow.cli import main; sys.exit(main())"
)


@dataclasses.dataclass
class Settings:
    """Generates one small data set in several ways."""

    pairs: int = 24
    """Pairs of frames."""
    rows_a_shard: int = 3
    """Pairs in a file."""
    kills: int = 10
    """How often a run is killed."""
    preset: str = "small"
    """paper or small."""
    samples: int = 1
    """Colour samples a pixel, 1 or 4."""
    seed: int = 0
    """Of the data set and of the moments."""


def start(settings: Settings, out: Path, *options: str) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-c", PROGRAM, str(settings.rows_a_shard), "generate", "--out", str(out)]
    command += ["--pairs", str(settings.pairs), "--preset", settings.preset, "--samples", str(settings.samples)]
    command += ["--seed", str(settings.seed), *options]
    return subprocess.Popen(command, start_new_session=True, stdout=subprocess.DEVNULL)


def finish(settings: Settings, out: Path, *options: str) -> float:
    """Seconds that a run took."""
    begin = time.perf_counter()
    if start(settings, out, *options).wait() != 0:
        sys.exit(f"generate {' '.join(options)} failed")
    return time.perf_counter() - begin


def kill(process: subprocess.Popen[bytes], after: float) -> bool:
    """Kill a run and its workers, unless it ends before."""
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
    """Kill and continue a run until it was killed often enough, and then let it end.

    Returns:
        How many finished shards there were at each kill, and how many data sets were finished between kills.
    """
    moments = random.Random(settings.seed)
    shards: list[int] = []
    finished = 0
    while len(shards) < settings.kills:
        # Loading takes the first seconds of a run: most kills shall come later.
        if kill(start(settings, out, "--workers", "2"), whole * moments.uniform(0.2, 1.0)):
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
