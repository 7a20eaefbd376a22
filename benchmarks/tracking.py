"""Identity switches and trajectory errors on generated sequences: `python benchmarks/tracking.py --data DIR`.

DIR holds sequences, for example of `objectflow generate --out DIR --split test --sequences 20`. Beside each method
stands an oracle row: true masks and motions through the same linking, which shows what the linking alone gets wrong.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

from objectflow import geometry
from objectflow.dataset.pairing import pair_of_frames
from objectflow.dataset.schema import SequenceRow
from objectflow.dataset.shards import open_sequences
from objectflow.evaluation.methods import parse_methods
from objectflow.methods.base import Estimator
from objectflow.motion import ObjectMotion, SceneMotion
from objectflow.tracking.tracker import Tracker
from objectflow.typing import BoolMask, Float64Array, LabelImage

ORACLE = "oracle"
FRAME_RATE = 60.0
MIN_IOU = 0.5
"""From which on a track is said to follow an object in a frame."""


@dataclasses.dataclass
class Settings:
    """Follows objects through sequences whose truth is known."""

    data: Path
    """Data set with sequences."""
    methods: tuple[str, ...] = ("consensus",)
    """Methods as `objectflow evaluate` names them: consensus, or sceneflownet-c-vl:weights=FILE; the oracle is always
    there."""
    split: str = "test"
    """Part of the data set."""
    sequences: int = 20
    """How many."""


@dataclasses.dataclass
class Score:
    """Sums over sequences.

    Attributes:
        seen: objects times frames in which they moved and are visible in at least 100 pixels.
        followed: how many of them a track follows.
        switches: how often an object's track is another one than the last that followed it.
        tracks: all tracks.
        errors: centimetres, of each followed object's centre against the truth, since its track followed it first.
    """

    seen: int = 0
    followed: int = 0
    switches: int = 0
    tracks: int = 0
    errors: list[float] = dataclasses.field(default_factory=list)


def main(settings: Settings) -> None:
    """Follow, score, print."""
    rows = open_sequences(settings.data, settings.split)
    grouped = itertools.groupby((rows[k] for k in range(len(rows))), key=lambda row: row.sequence)
    sequences = [list(frames) for _, frames in itertools.islice(grouped, settings.sequences)]
    table = Table(title=f"{len(sequences)} sequences of {len(sequences[0])} frames")
    for column in ("method", "followed", "switches", "a followed step", "tracks", "median error cm", "90% below cm"):
        table.add_column(column, justify="left" if column == "method" else "right")
    estimators: dict[str, Estimator | None] = {
        spec.label: spec.make() for spec in parse_methods(settings.methods, camera="static")
    }
    for method, estimator in (estimators | {ORACLE: None}).items():
        score = Score()
        for frames in sequences:
            add_sequence(score, frames, motions(estimator, frames))
        share = f"{score.followed}/{score.seen} ({score.followed / max(1, score.seen):.0%})"
        rate = f"{score.switches / max(1, score.followed):.3f}"
        median, most = (f"{np.percentile(score.errors, q):.2f}" for q in (50, 90)) if score.errors else ("-", "-")
        table.add_row(method, share, str(score.switches), rate, str(score.tracks), median, most)
    Console(width=110).print(table)


def motions(estimator: Estimator | None, frames: Sequence[SequenceRow]) -> Iterator[SceneMotion]:
    """The motion of every two frames that follow each other; without an estimator the true one."""
    for prev, curr in itertools.pairwise(frames):
        yield true_motion(prev, curr) if estimator is None else estimator(prev.image, curr.image)


def true_motion(prev: SequenceRow, curr: SequenceRow) -> SceneMotion:
    """What a method without faults would say."""
    objects, labels = [], np.zeros_like(curr.labels)
    for obj in pair_of_frames(prev, curr).objects:
        mask = (curr.labels == obj.label) & curr.image.valid
        if not mask.any():
            continue
        prev_T_curr = obj.prev_pose @ geometry.inverse(obj.curr_pose)
        labels[mask] = obj.label
        objects.append(ObjectMotion(obj.label, int(mask.sum()), 1.0, moved(obj.translation), obj.center, prev_T_curr))
    return SceneMotion(labels, np.zeros((*labels.shape, 3), np.float32), tuple(objects))


def moved(translation: Float64Array) -> bool:
    """Whether an object moved by more than half a centimetre between two frames."""
    return bool(np.linalg.norm(translation) > 0.005)


def add_sequence(score: Score, frames: Sequence[SequenceRow], found: Iterator[SceneMotion]) -> None:
    """Link one sequence's motions and compare with the truth."""
    tracker = Tracker()
    last: dict[int, int] = {}
    starts: dict[tuple[int, int], tuple[Float64Array, Float64Array]] = {}
    for (prev, curr), motion in zip(itertools.pairwise(frames), found, strict=True):
        links = tracker.update(prev.frame / FRAME_RATE, curr.image, curr.frame / FRAME_RATE, motion)
        tracks = {track.id: track for track in tracker.tracks}
        for obj in pair_of_frames(prev, curr).objects:
            mask = curr.labels == obj.label
            if not moved(obj.translation) or mask.sum() < 100:
                continue
            score.seen += 1
            number = best_match(mask, motion.labels, links)
            if number is None:
                continue
            score.followed += 1
            score.switches += obj.label in last and last[obj.label] != number
            last[obj.label] = number
            track = tracks[number]
            pose_before, true_before = starts.setdefault(
                (obj.label, number), (track.world_T_object[-2], obj.prev_pose)
            )
            # The whole motion since then, of the object's centre; the camera stands still.
            travelled = track.world_T_object[-1] @ geometry.inverse(pose_before)
            error = geometry.transform(travelled, true_before[:3, 3]) - obj.curr_pose[:3, 3]
            score.errors.append(100 * float(np.linalg.norm(error)))
    score.tracks += len(tracker.tracks)


def best_match(mask: BoolMask, labels: LabelImage, links: dict[int, int]) -> int | None:
    """The track whose object covers a true mask best, if it does by half."""
    best, number = MIN_IOU, None
    for label in np.unique(labels[mask]).tolist():
        if label in links:
            other = labels == label
            iou = float((mask & other).sum() / (mask | other).sum())
            if iou >= best:
                best, number = iou, links[label]
    return number


if __name__ == "__main__":
    main(tyro.cli(Settings))
