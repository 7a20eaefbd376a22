"""Recordings with the faults of real drivers: the right outcome of each, in one table.

    python benchmarks/cases.py ../shared/cases
    python benchmarks/cases.py ../shared/cases --only bag-plain bag-lens-wide

Every case is a folder; a function of its name states what is expected and finds out what comes out. The exit code is 1
if a case fails or has no folder.
"""

from __future__ import annotations

import contextlib
import io
import itertools
import json
import re
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

import cases_files
import cases_sequences
import objectflow
from objectflow.cli import main as run_command
from objectflow.errors import ObjectflowError
from objectflow.geometry.camera import Camera
from objectflow.readers import CameraOptions, FrameSource, open_source

LENGTH_TOLERANCE = 0.05
"""Largest relative error of a displacement, as that of the reference recordings."""
INTRINSICS_TOLERANCE = 0.6
"""Largest error of a focal length or of a principal point, pixels."""


@dataclass(frozen=True)
class Settings:
    """The cases to try."""

    folder: Annotated[Path, tyro.conf.Positional]
    """Folder with a folder for each case."""
    only: tuple[str, ...] = ()
    """Names of cases; all of them by default."""


class Outcome(NamedTuple):
    """What is expected of a case, and what came out."""

    expected: str
    found: str
    ok: bool


@dataclass(frozen=True)
class Case:
    """The function of each case, by the name of its folder."""

    functions: dict[str, Callable[[Path], Outcome]] = field(default_factory=dict)

    def __call__(self, name: str) -> Callable[[Callable[[Path], Outcome]], Callable[[Path], Outcome]]:
        """Register a function under the name of a folder."""

        def register(function: Callable[[Path], Outcome]) -> Callable[[Path], Outcome]:
            self.functions[name] = function
            return function

        return register


case = Case()


def main(settings: Settings) -> None:
    """Try the cases and print a table."""
    table = Table(show_edge=False)
    for column in ("case", "expected", "outcome", "ok"):
        table.add_column(column, overflow="fold")
    failed = 0
    names = settings.only or tuple(case.functions)
    for name in names:
        try:
            outcome = case.functions[name](settings.folder / name)
        except (ObjectflowError, KeyError) as error:
            outcome = Outcome("no error", f"{type(error).__name__}: {error}", ok=False)
        failed += not outcome.ok
        table.add_row(name, outcome.expected, outcome.found, "yes" if outcome.ok else "[bold red]NO")
    console = Console(highlight=False, width=160)
    console.print(table)
    console.print(f"{len(names) - failed} of {len(names)} cases right")
    if failed:
        raise SystemExit(1)


def displacements(source: FrameSource) -> list[list[float]]:
    """Displacements of the moving objects of each pair by `consensus`, centimetres, largest first."""
    estimator = objectflow.load("consensus")
    bounds = [0, *source.cuts, len(source)]
    found = []
    for start, end in itertools.pairwise(bounds):
        for prev, curr in itertools.pairwise([source[index] for index in range(start, end)]):
            motion = estimator(prev, curr)
            lengths = [100 * float(np.linalg.norm(obj.translation)) for obj in motion.objects if obj.moving]
            found.append(sorted(lengths, reverse=True))
    return found


def moves(folder: Path, expected: Sequence[float], note: str = "", options: CameraOptions | None = None) -> Outcome:
    """Whether the objects of a recording of two frames move by known lengths, and a note says what was corrected."""
    source = open_source(folder / "bag", options)
    (lengths,) = displacements(source)
    ok = len(lengths) == len(expected) and all(
        abs(a / b - 1) <= LENGTH_TOLERANCE for a, b in zip(lengths, expected, strict=True)
    )
    said = next((line for line in source.notes if note and note in line), "")
    words = " and ".join(f"{length:g} cm" for length in expected)
    found = " and ".join(f"{length:.2f} cm" for length in lengths) or "nothing"
    return Outcome(
        f"displacements of {words}{f'; a note ({note})' if note else ''}",
        f"{found}{f'; {said}' if said else ''}",
        ok and bool(said) == bool(note),
    )


def has_camera(folder: Path, camera: Camera, note: str = "") -> Outcome:
    """Whether a recording is read with known intrinsics, and its objects move by the lengths of the scene."""
    source = open_source(folder / "bag")
    motion = moves(folder, (8.1, 6.9), note)
    found = source.camera
    ok = (found.width, found.height) == (camera.width, camera.height) and all(
        abs(getattr(found, name) - getattr(camera, name)) <= INTRINSICS_TOLERANCE for name in ("fx", "fy", "cx", "cy")
    )
    return Outcome(f"{camera}; {motion.expected}", f"{found}; {motion.found}", ok and motion.ok)


def same_images(folder: Path, reference: Path, options: CameraOptions | None = None) -> Outcome:
    """Whether a recording in another encoding has the depth of one in a common encoding; colour may be lossy."""
    found, expected = (
        open_source(folder / "bag", options),
        open_source(reference / "bag", CameraOptions(depth_scale=1000)),
    )
    if len(found) != len(expected):
        return Outcome(f"the frames of {reference.name}", f"{len(found)} frames", ok=False)
    depth = max(float(np.abs(a.depth - b.depth).max()) for a, b in zip(found, expected, strict=True))
    color = max(float(np.abs(a.color.astype(int) - b.color).mean()) for a, b in zip(found, expected, strict=True))
    return Outcome(
        f"the depth of {reference.name} within a millimetre",
        f"depth differs by {1000 * depth:.2f} mm, colour by {color:.1f} of 255",
        depth <= 0.001 and color < 20,
    )


class RunResult(NamedTuple):
    """The result of `objectflow run`."""

    code: int
    output: str
    pairs: tuple[tuple[int, int], ...]
    tracks: int


def run(folder: Path, *options: str) -> RunResult:
    """Run `objectflow run` on a case."""
    output = io.StringIO()
    with tempfile.TemporaryDirectory() as temporary:
        out = Path(temporary) / "out"
        with contextlib.redirect_stdout(output), contextlib.redirect_stderr(output):
            code = run_command(["run", str(folder), "--out", str(out), *options])
        names = sorted(path.name for path in out.glob("pair_*"))
        tracks = len(json.loads((out / "tracks.json").read_text())["tracks"]) if code == 0 else 0
    pairs = tuple((int(name.split("_")[1]), int(name.split("_")[2])) for name in names)
    return RunResult(code, " ".join(output.getvalue().split()), pairs, tracks)


def follows(folder: Path, pairs: Sequence[tuple[int, int]], tracks: int, note: str = "", *options: str) -> Outcome:
    """Whether a run estimates known pairs, follows a known number of objects, and says what was corrected."""
    result = run(folder / "bag", *options)
    said = re.search(rf"{note}[^.]*", result.output) if note else None
    listed = ", ".join(f"{i}-{j}" for i, j in pairs)
    found = ", ".join(f"{i}-{j}" for i, j in result.pairs) or result.output
    return Outcome(
        f"pairs {listed}; {tracks} objects{f'; a note ({note})' if note else ''}",
        f"pairs {found}; {result.tracks} objects{f'; {said[0].strip()[:60]}' if said else ''}",
        result.code == 0 and result.pairs == tuple(pairs) and result.tracks == tracks and bool(said) == bool(note),
    )


STEADY = tuple(itertools.pairwise(range(8)))
"""Pairs of a recording of eight frames."""


@case("bag-plain")
def bag_plain(folder: Path) -> Outcome:
    return follows(folder, STEADY, 2)


@case("bag-geom-plain")
def bag_geom_plain(folder: Path) -> Outcome:
    return moves(folder, (8.1, 6.9))


@case("bag-lens-none")
def bag_lens_none(folder: Path) -> Outcome:
    return moves(folder, (8.1, 6.9))


@case("bag-lens-wide")
def bag_lens_wide(folder: Path) -> Outcome:
    return moves(folder, (8.1, 6.9), "undistorted")


@case("bag-unregistered")
def bag_unregistered(folder: Path) -> Outcome:
    return moves(folder, (8.1, 6.9), "registered to colour by /tf_static")


@case("bag-info-depth-before-aligned")
def bag_info_depth_before_aligned(folder: Path) -> Outcome:
    return has_camera(folder, Camera(640, 480, 525, 525, 319.5, 239.5))


@case("bag-binning-2")
def bag_binning(folder: Path) -> Outcome:
    # A displacement at half the resolution is less exact.
    source = open_source(folder / "bag")
    camera, expected = source.camera, Camera(320, 240, 262.5, 262.5, 159.75, 119.75)
    (lengths,) = displacements(source)
    return Outcome(
        f"{expected}; 2 objects", f"{camera}; {len(lengths)} objects", camera == expected and len(lengths) == 2
    )


@case("bag-roi-cropsize")
def bag_roi_cropsize(folder: Path) -> Outcome:
    return has_camera(folder, Camera(400, 300, 525, 525, 159.5, 119.5), "its offset is subtracted")


@case("bag-clock-set-back")
def bag_clock_set_back(folder: Path) -> Outcome:
    pairs = [pair for pair in STEADY if pair != (3, 4)]
    # Objects get new ids after the cut.
    return follows(folder, pairs, 4, "the time goes back")


@case("bag-duplicate-stamps")
def bag_duplicate_stamps(folder: Path) -> Outcome:
    return follows(folder, STEADY, 2, "8 repeated stamps")


@case("bag-one-zero-stamp")
def bag_one_zero_stamp(folder: Path) -> Outcome:
    return follows(folder, STEADY, 2, "1 of 8 stamps is missing")


@case("bag-empty-depth-middle")
def bag_empty_depth_middle(folder: Path) -> Outcome:
    pairs = ((0, 1), (1, 2), (2, 3), (3, 5), (5, 6), (6, 7))
    return follows(folder, pairs, 2, "1 frame left out")


@case("bag-32fc1-mm")
def bag_32fc1_mm(folder: Path) -> Outcome:
    code = run(folder / "bag", "--method", "zero").code
    found = same_images(folder, folder.parent / "bag-yuv422", CameraOptions(depth_scale=1000))
    return Outcome(
        f"refused without --depth-scale 1000; with it {found.expected}",
        f"exit code {code} without, {found.found} with it",
        code == 2 and found.ok,
    )


@case("bag-compresseddepth-rvl")
def bag_rvl(folder: Path) -> Outcome:
    return same_images(folder, folder.parent / "bag-yuv422")


@case("bag-depth-png-compressed")
def bag_depth_png(folder: Path) -> Outcome:
    return same_images(folder, folder.parent / "bag-yuv422")


@case("bag-yuv422")
def bag_yuv422(folder: Path) -> Outcome:
    return same_images(folder, folder.parent / "bag-depth-png-compressed")


@case("seq-hand")
def seq_hand(folder: Path) -> Outcome:
    outcome = cases_sequences.hand_over_table(folder)
    return Outcome("one track each of hand (7), things 3 and 6; thing 1 never moves", outcome.text, outcome.ok)


def of_files(entry: cases_files.Case) -> Callable[[Path], Outcome]:
    """The function of a case of image files."""

    def find(folder: Path) -> Outcome:
        if not folder.is_dir():
            return Outcome(entry.expected, "no such folder", ok=False)
        outcome = entry.find(folder)
        return Outcome(entry.expected, outcome.text, outcome.ok)

    return find


for file_case in cases_files.CASES:
    case(file_case)(of_files(cases_files.CASES[file_case]))


if __name__ == "__main__":
    main(tyro.cli(Settings))
