"""Time stamps as drivers write them, converted to ascending seconds: units, repeats, missing stamps and clock changes.

A recording's stamps may be in seconds, milliseconds, microseconds or nanoseconds; a driver may repeat a frame, leave a
stamp at 0 or deliver a frame late; and a clock may be set back, or a recording may restart. `normalise` returns the
frames that remain in the order of recording, with the positions at which the time restarts.
"""

from __future__ import annotations

import bisect
import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from objectflow.errors import ReaderError
from objectflow.typing import BoolMask, Float64Array, IndexArray

UNITS_PER_SECOND = {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}
"""Number of stamp units per second, by the name of the unit."""
_UNIT_NAMES = {"s": "seconds", "ms": "milliseconds", "us": "microseconds", "ns": "nanoseconds"}


@dataclass(frozen=True)
class StampSettings:
    """Thresholds for irregular stamps.

    Attributes:
        shortest_period_s: shortest plausible time between two frames, seconds. Stamps without an absolute date are in
            the unit in which their median period is at least this long and less than 1000 times as long.
        reorder_window: number of preceding frames among which a late frame is sorted in, and within which an equal
            stamp is a repeat.
        min_spacing: smallest time between a late frame and its neighbours, in median periods. A frame that would lie
            closer does not fill a gap: the clock was set back.
        max_repeat_delay: longest recording time between a frame and its repeat, in median periods.
    """

    shortest_period_s: float = 0.01
    reorder_window: int = 3
    min_spacing: float = 0.5
    max_repeat_delay: float = 1.5


@dataclass(frozen=True, eq=False)
class NormalisedStamps:
    """Usable frames of a recording and their times.

    Attributes:
        times_s: (K,) seconds of the kept frames in the order of recording, strictly ascending between two cuts.
        kept: (K,) index of each kept frame in the input.
        cuts: ascending positions in `kept` of the frames with which the time restarts; the first frame is none.
        notes: one sentence for each kind of irregularity.
    """

    times_s: Float64Array
    kept: IndexArray
    cuts: tuple[int, ...]
    notes: tuple[str, ...]


class _Kept(NamedTuple):
    time: float
    number: int


def normalise(
    stamps: ArrayLike,
    *,
    unit: str | None = None,
    recorded: ArrayLike | None = None,
    settings: StampSettings | None = None,
) -> NormalisedStamps:
    """Bring stamps to ascending seconds; repeats are dropped, and missing stamps are interpolated.

    Args:
        stamps: (N,) in the order of recording; a stamp that is 0, negative or not finite is missing.
        unit: "s", "ms", "us" or "ns"; None finds it by the magnitude of the stamps (`find_unit`).
        recorded: (N,) times of recording in any unit, where the source has them: they place missing stamps, and they
            replace the stamps if all of them are missing.
        settings: thresholds.

    Raises:
        ReaderError: no stamp is valid, and there are no times of recording.
    """
    settings = settings or StampSettings()
    values = np.asarray(stamps, dtype=np.float64).ravel()
    arrivals = None if recorded is None else np.asarray(recorded, dtype=np.float64).ravel()
    notes: list[str] = []
    missing = _find_missing(values)
    if len(values) and missing.all():
        if arrivals is None or _find_missing(arrivals).all():
            raise ReaderError("no time stamp is valid: all are 0, negative or not finite")
        notes.append("all stamps are 0: the times of recording are used instead")
        values, missing = arrivals, _find_missing(arrivals)
    known = values[~missing]
    found = unit or find_unit(known, settings)
    if unit is None and found != "s":
        notes.append(f"stamps are in {_UNIT_NAMES[found]}")
    times = values / UNITS_PER_SECOND[found]
    if missing.any():
        times = _interpolate(times, missing, arrivals)
        count = int(missing.sum())
        notes.append(
            f"{count} of {len(times)} stamps {'is' if count == 1 else 'are'} missing (0): interpolated from "
            f"{'its' if count == 1 else 'their'} neighbours"
        )
    segments, dropped, late = _split(times, arrivals, settings)
    if dropped:
        notes.append(f"{dropped} repeated stamp{'s' * (dropped != 1)}: the repeated frames are left out")
    if late:
        notes.append(f"{late} frame{'s' * (late != 1)} recorded late: sorted by time")
    cuts = np.cumsum([len(segment) for segment in segments[:-1]]).astype(int).tolist()
    for position, (before, after) in zip(cuts, itertools.pairwise(segments), strict=True):
        step = before[-1].time - after[0].time
        notes.append(
            f"the time goes back by {step:.3f} s after {position} frames (clock set back or recording restarted): "
            "no pair crosses this point"
        )
    kept = [entry for segment in segments for entry in segment]
    return NormalisedStamps(
        times_s=np.array([entry.time for entry in kept], dtype=np.float64),
        kept=np.array([entry.number for entry in kept], dtype=np.intp),
        cuts=tuple(cuts),
        notes=tuple(notes),
    )


def find_unit(stamps: ArrayLike, settings: StampSettings | None = None) -> str:
    """The unit of stamps: by their size if they count from 1970, otherwise by their median period.

    Args:
        stamps: (N,) valid stamps in the order of recording.
        settings: thresholds.

    Returns:
        "s", "ms", "us" or "ns".
    """
    settings = settings or StampSettings()
    values = np.asarray(stamps, dtype=np.float64).ravel()
    if not len(values):
        return "s"
    # Dates from 2001 to 2065 lie between 1e9 and 3e9 seconds, so that the units cannot be confused.
    middle = float(np.median(values))
    for name, per_second in UNITS_PER_SECOND.items():
        is_date = 1e9 * per_second <= middle <= 3e9 * per_second
        # Small units are certain; a few seconds since start in nanoseconds are as large as a date in seconds.
        if is_date and (name != "s" or _period(values) < 1e6 * settings.shortest_period_s):
            return name
    periods = _period(values) / settings.shortest_period_s
    return "s" if periods < 1e3 else "ms" if periods < 1e6 else "us" if periods < 1e9 else "ns"


def segment_numbers(stamps: NormalisedStamps) -> NDArray[np.intp]:
    """(K,) number of the segment of each kept frame, counted from 0."""
    return np.searchsorted(np.asarray(stamps.cuts, dtype=np.intp), np.arange(len(stamps.kept)), side="right")


def _period(values: Float64Array) -> float:
    """Median positive difference of consecutive stamps, in their unit; 0 if there is none."""
    steps = np.diff(values)
    steps = steps[steps > 0]
    return float(np.median(steps)) if len(steps) else 0.0


def _find_missing(values: Float64Array) -> BoolMask:
    """Stamps that are 0, negative or not finite; a 0 that is followed by about one period begins a recording."""
    missing: BoolMask = ~np.isfinite(values) | (values <= 0)
    period = _period(values[~missing])
    for index in np.flatnonzero(values[:-1] == 0).tolist():
        if 0 < values[index + 1] <= 2 * period:
            missing[index] = False
    return missing


def _interpolate(times: Float64Array, missing: BoolMask, arrivals: Float64Array | None) -> Float64Array:
    """Fill missing stamps linearly, by the times of recording if there are any; outside, by the median period."""
    known = np.flatnonzero(~missing)
    period = _period(times[known])
    filled = times.copy()
    for index in np.flatnonzero(missing).tolist():
        place = int(np.searchsorted(known, index))
        before = int(known[place - 1]) if place > 0 else None
        after = int(known[place]) if place < len(known) else None
        if before is not None and after is not None and times[after] > times[before]:
            share = (index - before) / (after - before)
            if arrivals is not None and arrivals[before] < arrivals[index] < arrivals[after]:
                share = (arrivals[index] - arrivals[before]) / (arrivals[after] - arrivals[before])
            filled[index] = times[before] + share * (times[after] - times[before])
        elif after is not None:
            filled[index] = times[after] - period * (after - index)
        elif before is not None:
            filled[index] = times[before] + period * (index - before)
    return filled


def _split(
    times: Float64Array, arrivals: Float64Array | None, settings: StampSettings
) -> tuple[list[list[_Kept]], int, int]:
    """Segments of ascending times, the number of repeats left out, and the number of late frames sorted in."""
    period = _period(times)
    arrival_period = 0.0 if arrivals is None else _period(arrivals)
    segments: list[list[_Kept]] = [[]]
    dropped = late = 0
    for index, time in enumerate(times.tolist()):
        segment = segments[-1]
        if segment and time <= segment[-1].time:
            recent = segment[-settings.reorder_window :]
            original = next((entry.number for entry in recent if entry.time == time), None)
            if original is not None and (
                original == segment[-1].number
                or (
                    arrivals is not None
                    and arrivals[index] - arrivals[original] <= settings.max_repeat_delay * arrival_period
                )
            ):
                dropped += 1
                continue
            following = times[index + 1] if index + 1 < len(times) else np.inf
            if following > segment[-1].time and _fills_gap(recent, time, period, settings):
                bisect.insort(segment, _Kept(time, index))
                late += 1
                continue
            segments.append([])
        segments[-1].append(_Kept(time, index))
    return segments, dropped, late


def _fills_gap(recent: Sequence[_Kept], time: float, period: float, settings: StampSettings) -> bool:
    """Whether a frame that was recorded late lies in a gap between two recent frames."""
    distances = [abs(entry.time - time) for entry in recent]
    return recent[0].time < time and min(distances) >= settings.min_spacing * period
