"""The cases of `cases.py` that are folders of image files, each with its expected outcome."""

from __future__ import annotations

import contextlib
import io
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from objectflow.cli import main as command_line
from objectflow.errors import ObjectflowError
from objectflow.motion import SceneMotion
from objectflow.readers import FrameSource, open_source


@dataclass(frozen=True)
class Outcome:
    """What happened to a case, in words, and whether that is the expected outcome."""

    text: str
    ok: bool


@dataclass(frozen=True)
class Case:
    """A case: the expected outcome in words, and the function that finds the outcome in a folder."""

    expected: str
    find: Callable[[Path], Outcome]


def median_depth(source: FrameSource) -> float:
    """Median over the frames that can be read of their median depths, metres."""
    found = []
    for index in range(len(source)):
        with contextlib.suppress(ObjectflowError):
            frame = source[index]
            found.append(float(np.median(frame.depth[frame.valid])))
    return float(np.median(found))


def run(folder: Path, *options: str) -> tuple[int, str]:
    """Run `objectflow run` with the method that estimates nothing: the exit code and all that it prints."""
    with tempfile.TemporaryDirectory() as out:
        printed = io.StringIO()
        with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed):
            code = command_line(["run", str(folder), "--method", "zero", "--out", f"{out}/result", *options])
        return code, printed.getvalue()


def estimate(folder: Path) -> SceneMotion:
    """The result of `objectflow estimate` with its default method."""
    with tempfile.TemporaryDirectory() as out:
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
            code = command_line(["estimate", str(folder), "--out", f"{out}/result"])
        if code:
            raise ObjectflowError(f"objectflow estimate exits with {code}")
        return SceneMotion.load(Path(out) / "result")


def read_whole(frames: int, metres: tuple[float, float], words: str = "") -> Callable[[Path], Outcome]:
    """A case that is read whole: its number of frames, its depth, and words that `run` prints."""

    def find(folder: Path) -> Outcome:
        source = open_source(folder)
        depth, (code, printed) = median_depth(source), run(folder)
        ok = (
            len(source) == frames
            and metres[0] < depth < metres[1]
            and code == 0
            and words in " ".join(printed.split())
        )
        note = next((line for line in printed.splitlines() if words and words in line), "")
        return Outcome(f"{len(source)} frames, {depth:.2f} m, exit code {code} {note}".strip(), ok)

    return find


def tum_nanoseconds(folder: Path) -> Outcome:
    """Stamps are seconds after reading, and `--dt` works on them."""
    source = open_source(folder)
    first, last = source.timestamp(0) or 0.0, source.timestamp(len(source) - 1) or 0.0
    code, printed = run(folder, "--dt", "0.5")
    ok = 1e9 < first < 3e9 and 0 < last - first < 10 and code == 0 and "stamps are in ns" in printed
    return Outcome(f"{len(source)} frames from {first:.2f} s on, {last - first:.2f} s long; said in a note", ok)


def tum_file_missing(folder: Path) -> Outcome:
    """The missing and the empty file are named, and the other six frames are used."""
    code, printed = run(folder)
    names = "depth/4.png" in printed and "depth/6.png" in printed
    ok = code == 0 and names and "2 frames left out" in printed and "5 pairs" in printed
    return Outcome(f"exit code {code}, 2 frames left out and named: {names}", ok)


def crop_off_center(folder: Path) -> Outcome:
    """The pair is estimated, and something moves."""
    motion = estimate(folder)
    moving = [obj for obj in motion.objects if obj.moving]
    return Outcome(f"{len(moving)} of {len(motion.objects)} objects move", len(moving) == 1)


def invalid_is_65535(folder: Path) -> Outcome:
    """The flow is NaN where depth is 65535, and the object that moves is found."""
    raw = cv2.imread(str(folder / "depth1.png"), cv2.IMREAD_UNCHANGED)
    motion = estimate(folder)
    missing = np.isnan(motion.scene_flow[raw == 65535]).all()
    with np.load(folder / "truth.npz") as truth:
        moved = np.isin(truth["labels"], truth["moved"]) & (raw != 65535)
    found = np.isin(motion.labels, [obj.id for obj in motion.objects if obj.moving])
    overlap = float((found & moved).sum() / max(1, (found | moved).sum()))
    return Outcome(
        f"flow NaN at all missing depth: {bool(missing)}; IoU of what moves {overlap:.2f}",
        bool(missing) and overlap > 0.5,
    )


NEAR = (0.9, 1.3)
"""Median depth of the recordings, metres."""
CASES: dict[str, Case] = {
    "tum-bom": Case("8 frames are read", read_whole(8, NEAR)),
    "tum-duplicate-stamps": Case("repeats left out, with a note", read_whole(4, NEAR, "repeated stamps")),
    "tum-file-missing": Case("2 frames left out and named", tum_file_missing),
    "tum-nanoseconds": Case("times are seconds", tum_nanoseconds),
    "folder-npy-depth": Case("depth of .npy files in metres", read_whole(8, NEAR)),
    "folder-one-more-colour": Case("8 whole frames, with a note", read_whole(8, (0, 10), "without a depth image")),
    "icl-associations": Case("5000 units a metre, with a note", read_whole(8, NEAR, "5000 depth units per metre")),
    "bop-scene": Case("its camera and its depth scale", read_whole(8, NEAR)),
    "crop-off-center": Case("estimated; one thing moves", crop_off_center),
    "invalid-is-65535": Case("65535 is missing", invalid_is_65535),
}
