"""The pairs of `objectflow run`: selected frames of a sequence, without those that cannot be read."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field

from objectflow.errors import FrameError, ReaderError
from objectflow.frame import RgbdFrame
from objectflow.readers import FrameSource

TIME_TOLERANCE = 0.0005
"""Seconds by which a frame may be early for `--dt`, for the jitter of timestamps."""
MAX_LEADING_FAILURES = 100
"""Number of frames that are tried at the start; if none of them can be read, none of the sequence can."""


def select_frames(
    sequence: FrameSource, every: int, dt: float | None, start: int = 0, stop: int | None = None
) -> list[list[int]]:
    """Select every N-th frame, or a frame every `dt` seconds, separately before and after each cut of the sequence.

    Args:
        sequence: the frames.
        every: step in frames; ignored if `dt` is given.
        dt: smallest time between two frames, seconds; the sequence must have times.
        start, stop: first frame, and the frame before which to stop; None for the end.

    Returns:
        Ascending frame numbers, one list per part of the sequence.
    """
    bounds = [0, *sequence.cuts, len(sequence)]
    last = len(sequence) if stop is None else stop
    parts = [range(max(first, start), min(end, last)) for first, end in itertools.pairwise(bounds)]
    if dt is None:
        return [list(part[::every]) for part in parts]
    return [_by_time(sequence, part, dt) for part in parts]


def _by_time(sequence: FrameSource, part: Sequence[int], dt: float) -> list[int]:
    taken, last = [], -math.inf
    for index in part:
        time = sequence.timestamp(index)
        if time is not None and time >= last + dt - TIME_TOLERANCE:
            taken.append(index)
            last = time
    return taken


@dataclass(eq=False)
class ReadablePairs:
    """Iterates over the pairs of consecutive selected frames; a frame that cannot be read is left out.

    Attributes:
        sequence: the frames.
        parts: selected frame numbers; no pair crosses from one part into the next.
        is_done: whether the result of a pair exists; its current frame is then not read.
        left_out: reason for each frame that was left out, by frame number.
    """

    sequence: FrameSource
    parts: Sequence[Sequence[int]]
    is_done: Callable[[int, int], bool]
    left_out: dict[int, ReaderError | FrameError] = field(default_factory=dict)
    _last: tuple[int, RgbdFrame] | None = None

    def __iter__(self) -> Iterator[tuple[int, int]]:
        """Yield `(previous, current)` frame numbers.

        Raises:
            ReaderError, FrameError: none of the first frames can be read.
        """
        for part in self.parts:
            prev: int | None = None
            for index in part:
                if prev is not None and self.is_done(prev, index):
                    yield prev, index
                elif not self._is_readable(index):
                    continue
                elif prev is not None:
                    yield prev, index
                prev = index

    def read(self, index: int) -> RgbdFrame:
        """Read a frame, or return it if it was read last."""
        if self._last is None or self._last[0] != index:
            self._last = index, self.sequence[index]
        return self._last[1]

    def _is_readable(self, index: int) -> bool:
        try:
            self.read(index)
        except (ReaderError, FrameError) as error:
            self.left_out[index] = error
            if self._last is None and len(self.left_out) >= MAX_LEADING_FAILURES:
                raise next(iter(self.left_out.values())) from None
            return False
        return True
