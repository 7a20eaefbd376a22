"""Identity switches and trajectory errors on generated sequences: `python benchmarks/tracking.py --data DIR`.

DIR holds sequences, for example from `objectflow generate --out DIR --split test --sequences 20`. An additional oracle
row tracks the true masks and motions, which isolates the errors of the association.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

from objectflow import geometry
from objectflow.dataset.pairing import pair_of_frames
from objectflow.dataset.schema import PairObject, SequenceRow
from objectflow.dataset.shards import open_sequences
from objectflow.evaluation.methods import parse_methods
from objectflow.methods.base import Estimator
from objectflow.motion import ObjectMotion, SceneMotion
from objectflow.tracking.tracker import Tracker
from objectflow.typing import BoolMask, Float64Array, LabelImage

ORACLE = "oracle"
FRAME_RATE = 60.0
MIN_IOU = 0.5
"""Minimum IoU at which an object counts as tracked in a frame."""


@dataclasses.dataclass
class Settings:
    """Tracks objects through sequences with ground truth."""

    data: Path
    """Data set with sequences."""
    methods: tuple[str, ...] = ("consensus",)
    """Methods as in `objectflow evaluate`, such as consensus or sceneflownet-c-vl:weights=FILE; the oracle is always
    included."""
    split: str = "test"
    """Split of the data set."""
    sequences: int = 20
    """Maximum number of sequences."""


MIN_PIXELS = 100
"""Number of visible pixels from which an object counts."""


@dataclasses.dataclass
class FollowedSteps:
    """Sums over sequences.

    Attributes:
        visible: number of object observations, i.e. moving objects with at least `MIN_PIXELS`, summed over frames.
        tracked: number of observations with a matching track.
        switches: number of identity switches.
    """

    visible: int = 0
    tracked: int = 0
    switches: int = 0

    def add_pair(
        self,
        prev: SequenceRow,
        curr: SequenceRow,
        motion: SceneMotion,
        links: Mapping[int, int],
        last: dict[int, int],
        known: LabelImage | None = None,
        followed: Collection[int] = (),
    ) -> Iterator[tuple[PairObject, int | None]]:
        """Count the moving objects of a pair.

        Args:
            prev, curr: consecutive frames of a sequence.
            motion: its estimate.
            links: the track of each object of the estimate.
            last: the last track of each true object of the sequence, which is updated.
            known: the masks of the known objects by track id; None without them.
            followed: the tracks that moved in this pair although its estimate lacks them.

        Yields:
            Each visible moving object and the track that follows it, if there is one.
        """
        pair = pair_of_frames(prev, curr)
        for obj in pair.objects:
            mask = curr.labels == obj.label
            if not moved(own_translation(obj, pair.camera_motion)) or mask.sum() < MIN_PIXELS:
                continue
            self.visible += 1
            # Several objects of an estimate may be pieces of one track.
            linked = np.zeros_like(motion.labels)
            for label, number in links.items():
                linked[motion.labels == label] = number
            track_id = best_match(mask, linked, {number: number for number in links.values()})
            if track_id is None and known is not None:
                track_id = best_match(mask, known, {number: number for number in followed})
            if track_id is not None:
                self.tracked += 1
                self.switches += obj.label in last and last[obj.label] != track_id
                last[obj.label] = track_id
            yield obj, track_id


@dataclasses.dataclass
class Score(FollowedSteps):
    """Sums over sequences; see `FollowedSteps`.

    Attributes:
        tracks: number of tracks.
        errors: error of each tracked object's centre, accumulated since the track's first match, centimetres.
    """

    tracks: int = 0
    errors: list[float] = dataclasses.field(default_factory=list)


def main(settings: Settings) -> None:
    """Track, score, print."""
    rows = open_sequences(settings.data, settings.split)
    grouped = itertools.groupby((rows[k] for k in range(len(rows))), key=lambda row: row.sequence)
    sequences = [list(frames) for _, frames in itertools.islice(grouped, settings.sequences)]
    table = Table(title=f"{len(sequences)} sequences of {len(sequences[0])} frames")
    for column in ("method", "tracked", "switches", "per tracked step", "tracks", "median error cm", "90% below cm"):
        table.add_column(column, justify="left" if column == "method" else "right")
    estimators: dict[str, Estimator | None] = {
        spec.label: spec.make() for spec in parse_methods(settings.methods, camera="static")
    }
    for method, estimator in (estimators | {ORACLE: None}).items():
        score = Score()
        for frames in sequences:
            add_sequence(score, frames, motions(estimator, frames))
        share = f"{score.tracked}/{score.visible} ({score.tracked / max(1, score.visible):.0%})"
        rate = f"{score.switches / max(1, score.tracked):.3f}"
        median, high = (f"{np.percentile(score.errors, q):.2f}" for q in (50, 90)) if score.errors else ("-", "-")
        table.add_row(method, share, str(score.switches), rate, str(score.tracks), median, high)
    Console(width=110).print(table)


def motions(estimator: Estimator | None, frames: Sequence[SequenceRow]) -> Iterator[SceneMotion]:
    """The motions of all consecutive pairs; the true ones if there is no estimator."""
    for prev, curr in itertools.pairwise(frames):
        yield true_motion(prev, curr) if estimator is None else estimator(prev.image, curr.image)


def true_motion(prev: SequenceRow, curr: SequenceRow) -> SceneMotion:
    """The result of a perfect method."""
    objects, labels = [], np.zeros_like(curr.labels)
    pair = pair_of_frames(prev, curr)
    for obj in pair.objects:
        mask = (curr.labels == obj.label) & curr.image.valid
        # Under a moving camera, objects at rest are background.
        if not mask.any() or (pair.camera_motion is not None and not moved(own_translation(obj, pair.camera_motion))):
            continue
        prev_T_curr = obj.prev_pose @ geometry.inverse(obj.curr_pose)
        labels[mask] = obj.label
        moving = moved(own_translation(obj, pair.camera_motion))
        objects.append(ObjectMotion(obj.label, int(mask.sum()), 1.0, moving, obj.center, prev_T_curr))
    return SceneMotion(labels, np.zeros((*labels.shape, 3), np.float32), tuple(objects), pair.camera_motion)


def own_translation(obj: PairObject, camera_motion: Float64Array | None) -> Float64Array:
    """(3,) metres: how far an object's centre moved in the world, in the current camera frame."""
    if camera_motion is None:
        return obj.translation
    return geometry.transform(geometry.inverse(camera_motion), obj.prev_pose[:3, 3]) - obj.curr_pose[:3, 3]


def moved(translation: Float64Array) -> bool:
    """Whether an object moved by more than 0.5 cm between two frames."""
    return bool(np.linalg.norm(translation) > 0.005)


def add_sequence(score: Score, frames: Sequence[SequenceRow], results: Iterator[SceneMotion]) -> None:
    """Track one sequence and compare with the ground truth."""
    tracker = Tracker()
    last: dict[int, int] = {}
    starts: dict[tuple[int, int], tuple[Float64Array, Float64Array]] = {}
    for (prev, curr), motion in zip(itertools.pairwise(frames), results, strict=True):
        links = tracker.update(prev.frame / FRAME_RATE, curr.image, curr.frame / FRAME_RATE, motion)
        tracks = {track.id: track for track in tracker.tracks}
        for obj, track_id in score.add_pair(prev, curr, motion, links, last):
            if track_id is None:
                continue
            track = tracks[track_id]
            start_pose, true_start = starts.setdefault(
                (obj.label, track_id), (track.world_T_object[-2], obj.prev_pose)
            )
            # Accumulated motion of the object's centre since the first match; the camera is static.
            accumulated = track.world_T_object[-1] @ geometry.inverse(start_pose)
            error = geometry.transform(accumulated, true_start[:3, 3]) - obj.curr_pose[:3, 3]
            score.errors.append(100 * float(np.linalg.norm(error)))
    score.tracks += len(tracker.tracks)


def camera_pose(row: SequenceRow) -> Float64Array:
    """(4, 4) `world_T_camera`; the world is the camera of the sequence's first frame."""
    return np.eye(4) if row.world_T_camera is None else row.world_T_camera


def best_match(mask: BoolMask, labels: LabelImage, links: Mapping[int, int]) -> int | None:
    """The track whose object has the largest IoU with a true mask, if it reaches the minimum."""
    best, track_id = MIN_IOU, None
    for label in np.unique(labels[mask]).tolist():
        if label in links:
            predicted = labels == label
            iou = float((mask & predicted).sum() / (mask | predicted).sum())
            if iou >= best:
                best, track_id = iou, links[label]
    return track_id


if __name__ == "__main__":
    main(tyro.cli(Settings))
