"""The recordings of `cases.py` that are judged by their tracks."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import NamedTuple

import numpy as np

import objectflow
from objectflow.readers import CameraOptions, open_source
from objectflow.tracking.sequence_estimator import SequenceEstimator

HAND = 7
"""Label of the hand in the truth."""
MOVERS = {3, 6, HAND}
"""Labels of what moves: two things and the hand."""
UNTOUCHED = 1
"""Label of the thing over which the hand lies for some frames without moving it."""


class SequenceOutcome(NamedTuple):
    """What came out of a recording, and whether it is right."""

    text: str
    ok: bool


def hand_over_table(folder: Path) -> SequenceOutcome:
    """Which true objects the tracks follow, and whether a thing at rest under a hand becomes a known object.

    Args:
        folder: a TUM directory with `truth.npz`, whose `labels` are (frames, H, W).
    """
    source = open_source(folder, CameraOptions())
    with np.load(folder / "truth.npz") as file:
        truth = file["labels"]
    sequence = SequenceEstimator(objectflow.load("rigidmatch", camera="static"))
    votes: dict[int, Counter[int]] = {}
    touched = 0.0
    for number in range(len(source)):
        step = sequence.update(source[number], float(number))
        if step is None:
            continue
        masks = [(track, step.motion.labels == label) for label, track in step.tracks.items()]
        masks += [(track, step.known == track) for track in step.followed]
        for track, mask in masks:
            true, counts = np.unique(truth[number][mask], return_counts=True)
            votes.setdefault(track, Counter()).update(dict(zip(true.tolist(), counts.tolist(), strict=True)))
        thing = truth[number] == UNTOUCHED
        touched = max(touched, float((step.known[thing] > 0).mean()) if thing.any() else 0.0)
    followed = sorted(votes[track].most_common(1)[0][0] for track in votes)
    gaps = sum(len(track.gaps) for track in sequence.tracks)
    text = f"tracks of {followed}, {gaps} gaps, at most {touched:.0%} of thing {UNTOUCHED} known"
    return SequenceOutcome(text, followed == sorted(MOVERS) and touched < 0.1)
