"""Pairing of a bag's colour and depth messages by their header stamps, within the parts of steady time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from objectflow.errors import ReaderError
from objectflow.readers.bag_messages import BagMessages
from objectflow.readers.timestamps import NormalisedStamps, normalise
from objectflow.readers.tum import MAX_TIME_DIFFERENCE, associate
from objectflow.typing import Float64Array, IndexArray


@dataclass(frozen=True)
class BagPairs:
    """The frames of a bag.

    Attributes:
        pairs: for each frame, the numbers of its colour and its depth message, and the colour stamp in seconds.
        cuts: ascending indices of the frames with which the time restarts.
        notes: irregular stamps, one sentence each.
    """

    pairs: tuple[tuple[int, int, float], ...]
    cuts: tuple[int, ...]
    notes: tuple[str, ...]


def pair_messages(
    path: Path, messages: BagMessages, color: str, depth: str, max_lag: float = MAX_TIME_DIFFERENCE
) -> BagPairs:
    """Pair colour and depth messages by their header stamps.

    Args:
        path: of the bag, for error messages.
        messages: of the bag.
        color, depth: topics.
        max_lag: largest time between a colour and a depth image, seconds.

    Raises:
        ReaderError: no two messages are close in time.
    """
    recorded = [np.array(messages.times(topic), dtype=np.float64) for topic in (color, depth)]
    stamps = [
        normalise(messages.stamps(topic), unit="ns", recorded=times)
        for topic, times in zip((color, depth), recorded, strict=True)
    ]
    parts = [
        np.split(np.arange(len(found.kept)), found.cuts) if len(found.kept) else [np.arange(0)] for found in stamps
    ]
    partners = _match_parts(stamps, parts, recorded)
    pairs: list[tuple[int, int, float]] = []
    cuts: list[int] = []
    for first, second in partners:
        times = stamps[0].times_s[first], stamps[1].times_s[second]
        found = associate(times[0].tolist(), times[1].tolist(), max_lag)
        if found and pairs:
            cuts.append(len(pairs))
        for i, j in found:
            numbers = int(stamps[0].kept[first[i]]), int(stamps[1].kept[second[j]])
            pairs.append((*numbers, float(times[0][i])))
    if not pairs:
        offset = float(np.median(stamps[1].times_s) - np.median(stamps[0].times_s))
        raise ReaderError(
            f"{path}: no {color} message lies within {max_lag} s of a {depth} message: their clocks are "
            f"{offset:+.3f} s apart: record both with the same clock"
        )
    return BagPairs(tuple(pairs), tuple(cuts), _merge_notes(stamps, (color, depth)))


def _match_parts(
    stamps: Sequence[NormalisedStamps], parts: Sequence[Sequence[IndexArray]], recorded: Sequence[Float64Array]
) -> list[tuple[IndexArray, IndexArray]]:
    """The depth part of each colour part: in order if there are as many of both, else the one recorded meanwhile."""
    if len(parts[0]) == len(parts[1]):
        return list(zip(parts[0], parts[1], strict=True))
    spans = [
        [(times[found.kept[part]].min(), times[found.kept[part]].max()) for part in topic]
        for found, topic, times in zip(stamps, parts, recorded, strict=True)
    ]
    matched = []
    for part, (start, end) in zip(parts[0], spans[0], strict=True):
        overlaps = [min(end, last) - max(start, first) for first, last in spans[1]]
        matched.append((part, parts[1][int(np.argmax(overlaps))]))
    return matched


def _merge_notes(stamps: Sequence[NormalisedStamps], topics: Sequence[str]) -> tuple[str, ...]:
    """The notes on both topics; what is true of both is said once."""
    shared = [note for note in stamps[0].notes if note in stamps[1].notes]
    single = [
        f"{topic}: {note}"
        for topic, found in zip(topics, stamps, strict=True)
        for note in found.notes
        if note not in shared
    ]
    return (*shared, *single)
