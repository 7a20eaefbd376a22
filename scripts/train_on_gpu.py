"""Generate pairs on all cores, then train `rigidmatch` on a GPU, all within a fixed time.

    python scripts/train_on_gpu.py OUT --minutes 12

OUT/data, OUT/clutter and OUT/tabletop receive as many pairs as the cores make in a third of the time, OUT/run is the
run of `objectflow train`, and OUT/weights.safetensors is the newest checkpoint, replaced every two minutes. The same
command continues what was interrupted. Needs the extras `synth` and `train`.
"""

from __future__ import annotations

import dataclasses
import json
import os
import shlex
import shutil
import subprocess
import sys
import threading
import time
from pathlib import Path

import tyro
from tyro.conf import Positional

ROOT = Path(__file__).resolve().parents[1]
PROGRAM = (sys.executable, "-m", "objectflow")
PRESETS = {"data": ("paper", 0.4), "clutter": ("clutter", 0.3), "tabletop": ("tabletop", 0.3)}
"""Folder, preset of its scenes, and share of the time for generation."""
PROBE = 4
"""Pairs of each process in the first part of a set."""
MARGIN = 0.85
"""Share of the time left that the next part of a set is sized for, since scenes take different times."""
CLOSING = 0.6
"""Minutes for the last validation and the last checkpoint."""


@dataclasses.dataclass(frozen=True)
class Settings:
    """Generates and trains within a fixed time."""

    out: Positional[Path]
    """Folder of data, run and weights."""
    minutes: float = 12.0
    """Time in all."""
    generation_share: float = 0.33
    """Share of the time for generation."""
    validation_pairs: int = 64
    """Pairs of falling piles for validation."""
    start_from: Path = ROOT / "src" / "objectflow" / "weights" / "rigidmatch.safetensors"
    """Weights to start from."""
    workers: int = os.cpu_count() or 1
    """Processes of generation."""
    preset: str = ""
    """Preset of all scenes, for a trial; by default those of the three sets."""
    recipe: str = "gpu"
    """Recipe of `objectflow train`."""
    options: str = "--no-compile --batch-size 32 --learning-rate 8e-4 --augment.turn 0.3"
    """More options of `objectflow train`, given as --options="...": compiling takes minutes of a short run."""
    copy_seconds: float = 120.0
    """Time between copies of the weights; checkpoints are written as often."""


def generate(settings: Settings, folder: str, split: str, pairs: int) -> None:
    """Make a set, or let it grow to a number of pairs."""
    preset = settings.preset or PRESETS[folder][0]
    words = ["--out", str(settings.out / folder), "--split", split, "--preset", preset, "--pairs", str(pairs)]
    workers = str(min(settings.workers, pairs))
    subprocess.run([*PROGRAM, "generate", *words, "--samples", "1", "--workers", workers], check=True)


def generate_within(settings: Settings, folder: str, seconds: float) -> int:
    """Make as many training pairs as fit into a time: the set grows by the speed of its last part."""
    started, pairs, more = time.monotonic(), 0, PROBE * settings.workers
    while more >= settings.workers:
        before = time.monotonic()
        generate(settings, folder, "train", pairs + more)
        pairs += more
        now = time.monotonic()
        more = int(MARGIN * (seconds - (now - started)) * more / (now - before))
    return pairs


def plan(settings: Settings) -> dict[str, float]:
    """Generate, and return the numbers of pairs and the minutes of training; an earlier plan is carried out again."""
    file = settings.out / "plan.json"
    if file.exists():
        found: dict[str, float] = json.loads(file.read_text())
        return found
    started = time.monotonic()
    generate(settings, "data", "val", settings.validation_pairs)
    seconds = 60 * settings.minutes * settings.generation_share
    made: dict[str, float] = {
        folder: generate_within(settings, folder, share * seconds) for folder, (_, share) in PRESETS.items()
    }
    made["minutes"] = settings.minutes - (time.monotonic() - started) / 60 - CLOSING
    file.write_text(json.dumps(made))
    return made


def copy_newest(run: Path, target: Path) -> None:
    """Copy the weights of the last checkpoint."""
    found = sorted((run / "checkpoints").glob("step-*/weights.safetensors"))
    if found:
        part = target.with_name(f".{target.name}.part")
        try:
            shutil.copyfile(found[-1], part)
        except FileNotFoundError:  # a newer checkpoint has just replaced it
            return
        part.replace(target)


def main(settings: Settings) -> None:
    """Generate, train, and keep the newest weights at hand."""
    settings.out.mkdir(parents=True, exist_ok=True)
    made = plan(settings)
    print(f"training for {made['minutes']:.1f} minutes on {sum(made[folder] for folder in PRESETS):.0f} pairs")
    run, target = settings.out / "run", settings.out / "weights.safetensors"
    data, *extra = (str(settings.out / folder) for folder in PRESETS)
    words = ["--recipe", settings.recipe, "--variant", "rigidmatch", "--data", data, "--extra-data", *extra]
    words += ["--start-from", str(settings.start_from), "--out", str(run), "--resume"]
    words += ["--minutes", f"{made['minutes']:.2f}", "--checkpoint-minutes", f"{settings.copy_seconds / 60:.2f}"]
    ended = threading.Event()

    def keep_copying() -> None:
        while not ended.wait(settings.copy_seconds):
            copy_newest(run, target)

    copier = threading.Thread(target=keep_copying)
    copier.start()
    try:
        subprocess.run([*PROGRAM, "train", *words, *shlex.split(settings.options)], check=True)
    finally:
        ended.set()
        copier.join()
        copy_newest(run, target)
    print(f"weights: {target}")


if __name__ == "__main__":
    main(tyro.cli(Settings))
