"""New pairs of the frames of real recordings: `python benchmarks/recombined_pairs.py`.

Pair folders named RECORDING_FIRST_SECOND hold two frames of one recording. Every two frames of a recording, in both
orders, are a pair; most of these are farther apart than the recorded ones. Prints, for each recording, how often the
camera's state is right, how many movers with a score above 0.5 lie where nothing can have moved, and how many of the
things that moved are found. What is true comes from `recording_places.py`.
"""

from __future__ import annotations

import dataclasses
import itertools
import re
from collections import defaultdict
from pathlib import Path

import tyro
from rich.console import Console
from rich.table import Table

import objectflow
from real_expectations import Expectation
from real_pairs import SHARED, judge_by_boxes, read_pair
from recording_places import RECORDINGS, Recording


@dataclasses.dataclass
class Settings:
    """Judges one method on new pairs of the frames of real recordings."""

    data: Path = SHARED / "data" / "real"
    """Folder of pair folders."""
    method: str = "rigidmatch"
    """Name of the method."""
    only: tuple[str, ...] = ()
    """Parts of the names of recordings: others are left out."""


@dataclasses.dataclass
class Sums:
    """Sums over the pairs of a recording."""

    pairs: int = 0
    cameras: int = 0
    wrong_pairs: int = 0
    false: int = 0
    found: int = 0
    moved: int = 0


def main(settings: Settings) -> None:
    """Print a row per recording, and a line per pair with a fault."""
    table = Table(title=f"{settings.method} on new pairs of the frames of real recordings")
    for column in ("recording", "pairs", "camera right", "pairs with a false mover", "false movers", "moved, found"):
        table.add_column(column)
    total = Sums()
    console = Console(width=150)
    for name, frames in read_recordings(settings).items():
        estimator = objectflow.load(settings.method, camera=RECORDINGS[name].camera)
        sums = Sums()
        for first, second in itertools.permutations(sorted(frames), 2):
            expected = expectation(RECORDINGS[name], first, second)
            verdict = judge_by_boxes(estimator(frames[first], frames[second]), expected)
            false = [fault for fault in verdict.faults if fault.startswith("false mover")]
            camera = any(fault.startswith("camera") for fault in verdict.faults)
            sums.pairs, sums.cameras = sums.pairs + 1, sums.cameras + (not camera)
            sums.false, sums.wrong_pairs = sums.false + len(false), sums.wrong_pairs + bool(false)
            sums.found, sums.moved = sums.found + len(verdict.found), sums.moved + len(expected.required)
            if false or camera:
                console.print(f"{name}, {first} to {second}: {'; '.join(verdict.faults)}")
        table.add_row(name, *_cells(sums))
        total = Sums(*(a + b for a, b in zip(dataclasses.astuple(total), dataclasses.astuple(sums), strict=True)))
    table.add_row("all", *_cells(total))
    console.print(table)


def _cells(sums: Sums) -> tuple[str, ...]:
    counts = (sums.pairs, sums.cameras, sums.wrong_pairs, sums.false)
    return (*map(str, counts), f"{sums.found} of {sums.moved}" if sums.moved else "-")


def read_recordings(settings: Settings) -> dict[str, dict[int, objectflow.RgbdFrame]]:
    """The frames of each known recording by their numbers."""
    out: dict[str, dict[int, objectflow.RgbdFrame]] = defaultdict(dict)
    for folder in sorted(settings.data.iterdir()):
        match = re.fullmatch(r"(.+)_(\d+)_(\d+)", folder.name)
        if match is None or match[1] not in RECORDINGS:
            continue
        if settings.only and not any(part in match[1] for part in settings.only):
            continue
        for number, frame in zip((int(match[2]), int(match[3])), read_pair(folder), strict=True):
            out[match[1]].setdefault(number, frame)
    return out


def expectation(recording: Recording, first: int, second: int) -> Expectation:
    """What is true in a pair: things are searched where they are in the second frame."""
    moved = {name: at[second] for name, at in recording.places.items() if second in at and at.get(first) != at[second]}
    required = {name: box for name, box in moved.items() if name in recording.required}
    others = tuple(box for name, box in moved.items() if name not in required)
    return Expectation(required, (*recording.allowed, *others), cameras=recording.cameras)


if __name__ == "__main__":
    main(tyro.cli(Settings))
