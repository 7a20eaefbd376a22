"""A directory of the TUM RGB-D benchmark: lists of times and files, and their association.

The directory holds `rgb.txt` and `depth.txt`, each line of which is `timestamp file`, or `associations.txt`, each line
of which is `timestamp file timestamp file` (ORB-SLAM, ICL-NUIM, ETH3D). A comma may separate the fields, and `#`
begins a comment. Depth PNGs hold 5000 units per metre. The two sensors are not synchronised, so each colour image of
the lists is paired with the depth image nearest in time.
"""

from __future__ import annotations

import codecs
import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from objectflow.errors import ReaderError
from objectflow.readers.assemble import Layout, assemble
from objectflow.readers.options import CameraOptions
from objectflow.readers.sequence import FramePaths, FrameSequence
from objectflow.readers.timestamps import NormalisedStamps, find_unit, normalise

TUM_DEPTH_SCALE = 5000.0
MAX_TIME_DIFFERENCE = 0.02
"""Largest time difference within a pair, seconds: the benchmark's limit, shorter than a frame at 30 Hz."""
ASSOCIATIONS = ("associations.txt", "associated.txt", "association.txt", "associate.txt")
"""Names of a list of colour and depth images that are already paired."""
MAX_LIST_BYTES = 1 << 26
"""Largest list, in bytes."""
UNORDERED_SHARE = 0.2
"""Share of steps back in time above which a list is unordered; fewer are a clock that was set back."""


class Entry(NamedTuple):
    """A line of a list: the stamp as it is written, a file, and where the line is, for messages."""

    stamp: str
    name: str
    where: str


def is_tum(folder: Path) -> bool:
    """Whether a folder holds the lists of a TUM directory."""
    return _has_lists(folder) or _find_associations(folder) is not None


def open_tum(folder: Path, options: CameraOptions | None = None) -> FrameSequence:
    """Open a TUM RGB-D directory; the frames have the times of the colour images.

    Stamps may be in seconds, milliseconds, microseconds or nanoseconds. Repeated stamps are left out, and no pair
    crosses a point at which the clock was set back.

    Raises:
        ReaderError: a list cannot be read or names a file outside the folder, no two images are close in time, no
            frame can be read, or there is no camera.
        CameraError: the camera file lacks intrinsics or holds invalid ones.
        FrameError: invalid depth scale.
    """
    if not _has_lists(folder):
        return _open_associations(folder, options)
    color, depth = (read_list(folder / name) for name in ("rgb.txt", "depth.txt"))
    for name, entries in (("rgb.txt", color), ("depth.txt", depth)):
        if not entries:
            raise ReaderError(f"{folder / name}: the list names no image")
    unit = _unit([entry.stamp for entry in (*color, *depth)])
    color_times, depth_times = (
        _normalise(folder / name, entries, unit) for name, entries in (("rgb.txt", color), ("depth.txt", depth))
    )
    limit = (options and options.max_lag) or MAX_TIME_DIFFERENCE
    pairs, cuts = _associate_parts(color_times, depth_times, limit)
    if not pairs:
        raise ReaderError(
            f"{folder}: no colour image of rgb.txt lies within {limit:g} s of a depth image of depth.txt"
            f"{_nearest(color_times, depth_times)}"
        )
    frames = [
        FramePaths(
            _inside(folder, color[int(color_times.kept[i])]),
            _inside(folder, depth[int(depth_times.kept[j])]),
            float(color_times.times_s[i]),
        )
        for i, j in pairs
    ]
    notes = tuple(dict.fromkeys(_named("rgb.txt", color_times) + _named("depth.txt", depth_times)))
    return assemble(folder, frames, options, Layout(TUM_DEPTH_SCALE), cuts=cuts, notes=notes)


def read_list(path: Path) -> list[Entry]:
    """Read `timestamp file` lines in the order of the file.

    Raises:
        ReaderError: the file cannot be read, or a line is malformed; the message holds its number.
    """
    return [Entry(words[0], words[1], where) for words, where in _read_lines(path, 2, "timestamp file")]


def associate(
    first: Sequence[float], second: Sequence[float], limit: float = MAX_TIME_DIFFERENCE
) -> list[tuple[int, int]]:
    """Pair two sorted lists of times one to one, greedily by increasing time difference.

    Args:
        first, second: seconds, ascending.
        limit: largest time difference within a pair, seconds.

    Returns:
        `(index in first, index in second)` in the order of `first`; unpaired times are omitted.
    """
    times = np.asarray(second, dtype=np.float64)
    starts = np.searchsorted(times, np.asarray(first) - limit, side="left")
    ends = np.searchsorted(times, np.asarray(first) + limit, side="right")
    candidates = sorted(
        (abs(first[i] - second[j]), i, j) for i in range(len(first)) for j in range(starts[i], ends[i])
    )
    taken_first: set[int] = set()
    taken_second: set[int] = set()
    pairs = []
    for _, i, j in candidates:
        if i not in taken_first and j not in taken_second:
            taken_first.add(i)
            taken_second.add(j)
            pairs.append((i, j))
    return sorted(pairs)


def _open_associations(folder: Path, options: CameraOptions | None) -> FrameSequence:
    path = _find_associations(folder)
    assert path is not None
    lines = _read_lines(path, 4, "timestamp file timestamp file")
    if not lines:
        raise ReaderError(f"{path}: the list names no image")
    first, second = ([Entry(words[k], words[k + 1], where) for words, where in lines] for k in (0, 2))
    # ICL-NUIM names depth first, ORB-SLAM colour.
    depth_first = "depth" in first[0].name.lower() and "depth" not in second[0].name.lower()
    color, depth = (second, first) if depth_first else (first, second)
    note = (
        f"{path.name}: {TUM_DEPTH_SCALE:g} depth units per metre, as in TUM directories (--depth-scale overrides it)"
    )
    stamps = [entry.stamp for entry in color]
    if _are_numbers(stamps):
        frames = [FramePaths(_inside(folder, a), _inside(folder, b)) for a, b in zip(color, depth, strict=True)]
        return assemble(folder, frames, options, Layout(TUM_DEPTH_SCALE), notes=(note,))
    times = _normalise(path, color, _unit(stamps))
    frames = [
        FramePaths(_inside(folder, color[index]), _inside(folder, depth[index]), time)
        for index, time in zip(times.kept.tolist(), times.times_s.tolist(), strict=True)
    ]
    notes = (*_named(path.name, times), note)
    return assemble(folder, frames, options, Layout(TUM_DEPTH_SCALE), cuts=times.cuts, notes=notes)


def _has_lists(folder: Path) -> bool:
    return (folder / "rgb.txt").is_file() and (folder / "depth.txt").is_file()


def _find_associations(folder: Path) -> Path | None:
    return next((folder / name for name in ASSOCIATIONS if (folder / name).is_file()), None)


def _read_lines(path: Path, count: int, form: str) -> list[tuple[list[str], str]]:
    """The first `count` fields of each line, and where the line is."""
    lines: list[tuple[list[str], str]] = []
    for number, line in enumerate(_read_text(path).splitlines(), start=1):
        words = line.split("#", 1)[0].replace(",", " ").replace(";", " ").split()
        where = f"{path}, line {number}"
        if not words or (not lines and words[0].lower().startswith(("time", "stamp"))):
            continue
        if len(words) < count or not all(word.isprintable() for word in words):
            raise ReaderError(f"{where}: expected `{form}`")
        for word in words[0:count:2]:
            try:
                valid = math.isfinite(float(word))
            except ValueError:
                valid = False
            if not valid:
                raise ReaderError(f"{where}: expected `{form}`")
        lines.append((words, where))
    return lines


def _read_text(path: Path) -> str:
    if path.exists() and not path.is_file():
        raise ReaderError(f"{path}: a list must be a regular file")
    try:
        if path.stat().st_size > MAX_LIST_BYTES:
            raise ReaderError(f"{path}: too large for a list (at most {MAX_LIST_BYTES >> 20} MiB)")
        data = path.read_bytes()
        # Editors on Windows write a byte-order mark, in UTF-8 or in UTF-16.
        is_wide = data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
        return data.decode("utf-16" if is_wide else "utf-8-sig")
    except FileNotFoundError:
        raise ReaderError(f"{path}: no such file") from None
    except (OSError, UnicodeDecodeError) as error:
        raise ReaderError(f"{path}: cannot be read as text: {error}") from error


def _inside(folder: Path, entry: Entry) -> Path:
    """The path of a listed file, which must lie below the folder."""
    name = os.path.normpath(entry.name.replace("\\", "/"))
    if os.path.isabs(name):
        name = os.path.relpath(name, os.path.abspath(folder))
    if name == ".." or name.startswith("../"):
        raise ReaderError(f"{entry.where}: {entry.name} lies outside the folder of the list")
    return folder / name


def _unit(stamps: Sequence[str]) -> str:
    """The unit of stamps: seconds if they have decimals, otherwise by their magnitude."""
    if any("." in stamp for stamp in stamps):
        return "s"
    return find_unit([value for stamp in stamps if (value := float(stamp)) > 0])


def _are_numbers(stamps: Sequence[str]) -> bool:
    """Whether stamps count frames by 1 and are no times."""
    values = [float(stamp) for stamp in stamps]
    return values[0] < 1e6 and all(value == values[0] + index for index, value in enumerate(values))


def _normalise(path: Path, entries: Sequence[Entry], unit: str) -> NormalisedStamps:
    """Ascending times of a list, in seconds; `kept` refers to the entries."""
    stamps = np.array([float(entry.stamp) for entry in entries])
    order = np.arange(len(stamps))
    if len(stamps) > 2 and float((np.diff(stamps) < 0).mean()) > UNORDERED_SHARE:
        order = np.argsort(stamps, kind="stable")
    try:
        found = normalise(stamps[order], unit=unit)
    except ReaderError as error:
        raise ReaderError(f"{path}: {error}") from error
    notes = found.notes if unit == "s" else (f"stamps are in {unit}, not in seconds", *found.notes)
    return NormalisedStamps(found.times_s, order[found.kept], found.cuts, notes)


def _named(name: str, times: NormalisedStamps) -> tuple[str, ...]:
    return tuple(f"{name}: {note}" for note in times.notes)


def _associate_parts(
    color: NormalisedStamps, depth: NormalisedStamps, limit: float
) -> tuple[list[tuple[int, int]], tuple[int, ...]]:
    """Pairs of positions in the two lists, and the numbers of the pairs before which the clock was set back.

    A part of the colour list between two cuts is paired with the same part of the depth list. If one list alone has
    cuts, each part of colour is paired with all of depth.
    """
    bounds = [[0, *times.cuts, len(times.kept)] for times in (color, depth)]
    whole = len(color.cuts) != len(depth.cuts)
    pairs: list[tuple[int, int]] = []
    cuts = []
    for part, (start, end) in enumerate(zip(bounds[0], bounds[0][1:], strict=False)):
        low, high = (0, len(depth.kept)) if whole else (bounds[1][part], bounds[1][part + 1])
        order = low + np.argsort(depth.times_s[low:high], kind="stable")
        found = associate(color.times_s[start:end].tolist(), depth.times_s[order].tolist(), limit)
        if pairs and found:
            cuts.append(len(pairs))
        pairs += [(start + i, int(order[j])) for i, j in found]
    return pairs, tuple(cuts)


def _nearest(color: NormalisedStamps, depth: NormalisedStamps) -> str:
    """The smallest time difference in words, with the option that admits it."""
    ordered = np.sort(depth.times_s)
    at = np.searchsorted(ordered, color.times_s)
    differences = [
        np.abs(ordered[np.clip(at + shift, 0, len(ordered) - 1)] - color.times_s).min() for shift in (-1, 0)
    ]
    smallest = float(min(differences))
    if smallest > 1:
        return f": their clocks are {float(np.median(depth.times_s) - np.median(color.times_s)):+.3f} s apart"
    return f"; the smallest difference is {smallest:.3f} s: --max-lag {math.ceil(smallest * 110) / 100:g} admits it"
