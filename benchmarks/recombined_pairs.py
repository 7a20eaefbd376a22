"""New pairs of the frames of real recordings: `python benchmarks/recombined_pairs.py`.

Pair folders named RECORDING_FIRST_SECOND hold two frames of one recording. Every two frames of a recording, in both
orders, are a pair; most of these are farther apart than the recorded ones. Prints, for each recording, how often the
camera's state is right, how many movers with a score above 0.5 lie where nothing can have moved, and how many of the
things that moved are found. Where things are in each frame is known by eye.
"""

from __future__ import annotations

import dataclasses
import itertools
import re
from collections import defaultdict
from collections.abc import Mapping
from pathlib import Path

import tyro
from rich.console import Console
from rich.table import Table

import objectflow
from objectflow.alignment.camera_estimate import CameraState
from real_expectations import Box, Expectation
from real_pairs import SHARED, judge_by_boxes, read_pair

Places = Mapping[str, Mapping[int, Box]]
"""Where each thing is, by its name and the number of the frame."""

BIN: Places = {
    "ball": {
        12: (0.41, 0.24, 0.54, 0.46), 13: (0.36, 0.27, 0.49, 0.48), 14: (0.34, 0.29, 0.47, 0.51),
        15: (0.31, 0.30, 0.44, 0.53), 21: (0.19, 0.37, 0.34, 0.63), 22: (0.18, 0.39, 0.33, 0.66),
    },
    "carrot": {
        12: (0.03, 0.10, 0.30, 0.43), 13: (0.02, 0.12, 0.29, 0.44), 14: (0.00, 0.13, 0.29, 0.45),
        15: (0.00, 0.16, 0.29, 0.46), 21: (0.07, 0.19, 0.39, 0.47), 22: (0.10, 0.19, 0.42, 0.46),
    },
    "doll": {
        12: (0.29, 0.55, 0.46, 0.83), 13: (0.28, 0.58, 0.46, 0.84), 14: (0.28, 0.59, 0.45, 0.84),
        15: (0.28, 0.60, 0.46, 0.85), 21: (0.37, 0.64, 0.55, 0.89), 22: (0.40, 0.65, 0.57, 0.91),
    },
    "hand": dict.fromkeys(range(12, 16), (0.80, 0.00, 1.00, 0.50)),
}  # fmt: skip
FIRST_TABLE: Places = {
    "brown box": {
        4: (0.46, 0.42, 0.58, 0.70), 5: (0.48, 0.39, 0.60, 0.63), 10: (0.62, 0.37, 0.71, 0.64),
        11: (0.62, 0.37, 0.71, 0.64),
    },
    "yellow box": {
        4: (0.61, 0.52, 0.75, 0.75), 5: (0.61, 0.52, 0.75, 0.75), 10: (0.33, 0.55, 0.47, 0.81),
        11: (0.24, 0.56, 0.39, 0.83),
    },
}  # fmt: skip
SECOND_TABLE: Places = {
    "brown box": {
        3: (0.42, 0.19, 0.58, 0.52), 4: (0.49, 0.17, 0.62, 0.45), 5: (0.43, 0.13, 0.54, 0.39),
        6: (0.43, 0.13, 0.54, 0.39),
    },
    "yellow box": {
        3: (0.65, 0.26, 0.78, 0.47), 4: (0.65, 0.26, 0.78, 0.47), 5: (0.65, 0.26, 0.78, 0.47),
        6: (0.61, 0.29, 0.76, 0.55),
    },
}  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Recording:
    """What is true in all frames of a recording.

    Attributes:
        places: things that may move; one moves between two frames in which it is at different places.
        required: those that must be found where they moved.
        allowed: where else something may move.
        cameras: the states of the camera that are right.
        camera: the camera, if users would have to name it.
    """

    places: Places = dataclasses.field(default_factory=dict)
    required: tuple[str, ...] = ()
    allowed: tuple[Box, ...] = ()
    cameras: tuple[CameraState, ...] = ("static",)
    camera: str = "auto"


RECORDINGS: Mapping[str, Recording] = {
    "anygrasp": Recording(BIN, ("ball",), cameras=("static", "moving", "unknown"), camera="moving"),
    "brain": Recording(allowed=((0.15, 0.0, 1.0, 0.76),)),
    "cup": Recording(allowed=((0.0, 0.18, 0.55, 0.97),)),
    "maizena2f_c1": Recording(FIRST_TABLE, ("brown box", "yellow box")),
    "maizena2f_c2": Recording(SECOND_TABLE, ("brown box", "yellow box"), allowed=((0.85, 0.25, 1.0, 0.8),)),
    "tumrpy": Recording(cameras=("moving", "unknown")),
}
"""The recordings by the names of their pair folders: a bin below a moving camera, a hand with toys and an arm with a
mug before static ones, two tables with boxes (the second with somebody on a chair at the right border), and a camera
that is turned fast in a static room."""


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
