"""A directory of the TUM RGB-D benchmark: `rgb.txt` and `depth.txt`, associated by time.

Each line of the two lists is `timestamp file`, with `#` before comments; depth PNGs hold 5000 units per metre. The
two sensors are not synchronised, so each colour image is paired with the depth image nearest in time.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from objectflow.errors import ReaderError
from objectflow.readers.options import CameraOptions
from objectflow.readers.sequence import FramePaths, FrameSequence

TUM_DEPTH_SCALE = 5000.0
MAX_TIME_DIFFERENCE = 0.02
"""Largest time difference within a pair, seconds: the benchmark's limit, shorter than a frame at 30 Hz."""


def is_tum(folder: Path) -> bool:
    """Whether a folder holds the two lists of a TUM directory."""
    return (folder / "rgb.txt").is_file() and (folder / "depth.txt").is_file()


def open_tum(folder: Path, options: CameraOptions | None = None) -> FrameSequence:
    """Open a TUM RGB-D directory; frames are sorted by the times of the colour images.

    Raises:
        ReaderError: a list cannot be read, no two images are close in time, or there is no camera.
        CameraError: the camera file lacks intrinsics or holds invalid ones.
        FrameError: invalid depth scale.
    """
    color, depth = read_list(folder / "rgb.txt"), read_list(folder / "depth.txt")
    pairs = associate([time for time, _ in color], [time for time, _ in depth])
    if not pairs:
        raise ReaderError(
            f"{folder}: no colour image of rgb.txt lies within {MAX_TIME_DIFFERENCE} s of a depth image of depth.txt"
        )
    frames = tuple(FramePaths(folder / color[i][1], folder / depth[j][1], timestamp=color[i][0]) for i, j in pairs)
    setup = (options or CameraOptions()).resolve(folder, frames[0].color, TUM_DEPTH_SCALE)
    return FrameSequence(frames, setup.camera, setup.depth_scale)


def read_list(path: Path) -> list[tuple[float, str]]:
    """Read `timestamp file` lines, sorted by time.

    Raises:
        ReaderError: the file cannot be read, or a line is malformed; the message holds its number.
    """
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except FileNotFoundError:
        raise ReaderError(f"{path}: no such file") from None
    except (OSError, UnicodeDecodeError) as error:
        raise ReaderError(f"{path}: cannot be read as text: {error}") from error
    entries = []
    for number, line in enumerate(lines, start=1):
        words = line.split("#", 1)[0].split()
        if not words:
            continue
        try:
            time, name = float(words[0]), words[1]
        except (ValueError, IndexError):
            raise ReaderError(f"{path}, line {number}: expected `timestamp file`") from None
        if not math.isfinite(time) or not name.isprintable():
            raise ReaderError(f"{path}, line {number}: expected `timestamp file`")
        entries.append((time, name))
    return sorted(entries)


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
