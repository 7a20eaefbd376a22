"""Checks of a whole source: frames that cannot be read, repeated images, irregular times."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from objectflow.diagnosis.finding import Finding
from objectflow.diagnosis.settings import SourceCheckSettings
from objectflow.errors import FrameError, ReaderError
from objectflow.frame import RgbdFrame
from objectflow.readers import FrameSource

DEFAULTS = SourceCheckSettings()


class ReadPair(NamedTuple):
    """Two frames of a source and their numbers."""

    prev_index: int
    curr_index: int
    prev: RgbdFrame
    curr: RgbdFrame


def read_pair(
    source: FrameSource, pair: tuple[int, int] | None = None, *, settings: SourceCheckSettings = DEFAULTS
) -> ReadPair:
    """Read the two frames to examine.

    Args:
        source: the frames.
        pair: their numbers; None for two frames that can be read, from the middle of the source on.
        settings: see there.

    Raises:
        ReaderError: a number is not that of a frame, or fewer than two frames can be read.
        FrameError: a frame of `pair` is invalid.
    """
    count = len(source)
    if pair is not None:
        if not 0 <= pair[0] < pair[1] < count:
            raise ReaderError(f"--pair {pair[0]} {pair[1]}: expected two ascending numbers from 0 to {count - 1}")
        return ReadPair(*pair, source[pair[0]], source[pair[1]])
    middle = max(0, min(count // 2, count - 2))
    errors: list[ReaderError | FrameError] = []
    first = _find_readable(source, [*range(middle, count), *reversed(range(middle))], errors)
    if first is not None:
        apart = [index for index in range(first[0] + 1, count) if _is_apart(source, first[0], index, settings)]
        near = [index for index in range(first[0] + 1, count) if index not in set(apart)]
        second = _find_readable(source, [*apart, *reversed(near), *reversed(range(first[0]))], errors)
        if second is not None:
            (prev_index, prev), (curr_index, curr) = sorted((first, second), key=lambda entry: entry[0])
            return ReadPair(prev_index, curr_index, prev, curr)
    if errors:
        raise errors[0]
    raise ReaderError(f"the source has {count} frame{'s' * (count != 1)}: a pair needs two")


def examine_source(source: FrameSource, *, settings: SourceCheckSettings = DEFAULTS) -> list[Finding]:
    """Check the times of all frames and a sample of the images; each note of the reader becomes a finding."""
    findings = [Finding("source", "note", note) for note in source.notes]
    return [*findings, _check_times(source, settings), *_check_images(source, settings)]


def _find_readable(
    source: FrameSource, indices: Sequence[int], errors: list[ReaderError | FrameError]
) -> tuple[int, RgbdFrame] | None:
    for index in indices:
        try:
            return index, source[index]
        except (ReaderError, FrameError) as error:
            errors.append(error)
    return None


def _is_apart(source: FrameSource, first: int, second: int, settings: SourceCheckSettings) -> bool:
    times = source.timestamp(first), source.timestamp(second)
    return times[0] is None or times[1] is None or times[1] - times[0] >= settings.min_gap


def _check_times(source: FrameSource, settings: SourceCheckSettings) -> Finding:
    times = [source.timestamp(index) for index in range(len(source))]
    known = np.array([time for time in times if time is not None])
    if len(known) < len(times) or len(known) < 2:
        return Finding("times", "fine", "the source has no times: frames are numbered")
    steps = np.diff(known)
    period = float(np.median(steps))
    text = f"{known[-1] - known[0]:.2f} s, one frame every {1000 * period:.0f} ms"
    forward = steps[steps > 0]
    if period > 0 and len(forward) and forward.max() > settings.large_gap * period:
        index = int(steps.argmax())
        text += f"; {forward.max():.2f} s between frames {index} and {index + 1}: frames are missing"
        return Finding("times", "note", text)
    return Finding("times", "fine", text)


def _check_images(source: FrameSource, settings: SourceCheckSettings) -> list[Finding]:
    """Compare consecutive frames, spread over the source."""
    count = len(source)
    number = min(settings.samples, max(1, count - 1))
    starts = np.unique(np.linspace(0, max(0, count - 2), number).round().astype(int)).tolist()
    compared, repeated = 0, {"colour": 0, "depth": 0}
    errors: dict[int, ReaderError | FrameError] = {}
    for index in starts:
        pair: list[RgbdFrame] = []
        for position in (index, index + 1):
            try:
                pair.append(source[position])
            except (ReaderError, FrameError) as error:
                errors[position] = error
        if len(pair) == 2:
            compared += 1
            repeated["colour"] += np.array_equal(pair[0].color, pair[1].color)
            repeated["depth"] += np.array_equal(pair[0].depth, pair[1].depth)
    read = len({number for index in starts for number in (index, index + 1)})
    text = f"{read} frames read"
    if errors:
        text = f"{len(errors)} of {text} cannot be used and are left out, such as {next(iter(errors.values()))}"
    findings = [Finding("frames", "suspicious" if errors else "fine", text)]
    text = f"{compared} pairs of consecutive frames compared"
    worst = [f"{name} repeats in {number}" for name, number in repeated.items() if number]
    if worst:
        text += f": {', '.join(worst)}: the driver repeats images, or colour and depth have different rates"
        return [*findings, Finding("repeated images", "suspicious", text)]
    return [*findings, Finding("repeated images", "fine", f"{text}: none repeats")]
