"""Objects through time and their shapes, on generated sequences: `python benchmarks/sequences.py --data DIR`.

DIR holds sequences of `objectflow generate --out DIR --preset clutter --split test --sequences 20 --frames 30`. The
noise of a depth camera is added to their exact depth. The row `oracle` has the true masks and motions. For sequences
with a moving camera (`--camera-turn 1 --camera-shift 0.005`), add `--camera moving`.
"""

from __future__ import annotations

import copy
import dataclasses
import itertools
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import tyro
from rich.console import Console

from objectflow import geometry
from objectflow.alignment.frame_pair import FramePair
from objectflow.dataset.schema import SequenceRow
from objectflow.dataset.shards import open_sequences
from objectflow.evaluation.methods import parse_methods
from objectflow.frame import RgbdFrame
from objectflow.geometry.depth_noise import STRUCTURED_LIGHT
from objectflow.geometry.symmetry import SymmetryAxis
from objectflow.methods.base import Estimator, PairEstimator, closer
from objectflow.motion import SceneMotion
from objectflow.tracking.arrivals import ArrivalSettings
from objectflow.tracking.known_settings import KnownSettings
from objectflow.tracking.reconstruction import SequenceView
from objectflow.tracking.sequence_estimator import SequenceEstimator
from objectflow.tracking.track import Track
from objectflow.typing import BoolMask, Float64Array, LabelImage
from sequence_models import add_models
from sequence_scores import BEFORE, END, Score, following_table, model_table, pose_table, time_table
from tracking import FRAME_RATE, MIN_PIXELS, ORACLE, best_match, camera_pose, true_motion

REST_SHIFT = 0.0005
"""Metres between two frames, below which an object is at rest."""
REST_TURN = 0.2
"""Degrees between two frames, below which an object is at rest."""


@dataclasses.dataclass
class Settings:
    """Follows and models objects through sequences with ground truth."""

    data: Path
    """Data set with sequences."""
    methods: tuple[str, ...] = ("rigidmatch",)
    """Methods as in `objectflow evaluate`; the oracle is always included."""
    camera: str = "static"
    """static, moving or auto, for all methods."""
    split: str = "test"
    """Split of the data set."""
    sequences: int = 20
    """Maximum number of sequences."""
    noise: float = 1.0
    """Standard deviation of depth, in those of a structured-light camera; 0 for exact depth."""
    skip_explained: bool = False
    """Estimate no pair that the known objects explain, as `objectflow live` does."""
    sure_only: bool = False
    """Begin tracks with sure motions only, not where an object whose motion is unsure is certainly new."""
    meshes: Path | None = None
    """Folder for the meshes; None to write none."""


class MovingStep(NamedTuple):
    """A visible step of a true object.

    Attributes:
        label: of the object.
        times: of both frames.
        mask: (H, W) bool in the current frame.
        poses: (4, 4) each, the object's true poses in the world in both frames.
        symmetry: of the object.
        track: that followed it at once; None for none.
    """

    label: int
    times: tuple[float, float]
    mask: BoolMask
    poses: tuple[Float64Array, Float64Array]
    symmetry: Sequence[SymmetryAxis]
    track: int | None


def main(settings: Settings) -> None:
    rows = open_sequences(settings.data, settings.split)
    grouped = itertools.groupby((rows[k] for k in range(len(rows))), key=lambda row: row.sequence)
    sequences = [list(frames) for _, frames in itertools.islice(grouped, settings.sequences)]
    estimators: dict[str, Estimator | None] = {
        spec.label: spec.make() for spec in parse_methods(settings.methods, camera=settings.camera)
    }
    scores = {method: Score() for method in (*estimators, ORACLE)}
    for number, frames in enumerate(sequences):
        images = [noisy(row.image, settings.noise, number) for row in frames]
        skip = settings.skip_explained
        known = KnownSettings(arrival=ArrivalSettings(min_pixels=10**9)) if settings.sure_only else None
        for method, estimator in (estimators | {ORACLE: None}).items():
            folder = None if settings.meshes is None else settings.meshes / method / frames[0].sequence
            add_sequence(scores[method], frames, images, estimator, folder, skip, known)
    console = Console(width=120)
    title = f"{len(sequences)} sequences of {len(sequences[0])} frames"
    tables = following_table(title, scores), model_table(scores), pose_table(scores), time_table(scores)
    console.print(*tables, sep="\n")


def noisy(frame: RgbdFrame, scale: float, seed: int) -> RgbdFrame:
    """The frame with normally distributed depth noise that grows with depth."""
    if scale == 0:
        return frame
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(int(frame.depth.sum()),)))
    noise = scale * STRUCTURED_LIGHT.sigma(frame.depth) * rng.standard_normal(frame.depth.shape)
    depth = np.where(frame.valid, np.maximum(frame.depth + noise, 1e-3), 0).astype(np.float32)
    return RgbdFrame(frame.color, depth, frame.camera, frame.timestamp, frame.name)


class TimedEstimator(PairEstimator):
    """An estimator, or the true motions without one, on the frames of a sequence; consecutive pairs are timed."""

    def __init__(
        self, estimator: Estimator | None, frames: Sequence[SequenceRow], images: Sequence[RgbdFrame], score: Score
    ) -> None:
        self.estimator, self.frames, self.score = estimator, frames, score
        self.numbers = {id(image): number for number, image in enumerate(images)}

    def estimate(self, pair: FramePair) -> SceneMotion:
        """See `PairEstimator`."""
        prev, curr = pair.prev.frame, pair.curr.frame
        first, second = self.numbers[id(prev)], self.numbers[id(curr)]
        began = time.process_time()
        if self.estimator is None:
            found = true_motion(self.frames[first], self.frames[second])
        else:
            found = self.estimator(prev, curr)
        if second == first + 1:
            self.score.estimating += time.process_time() - began
        return found

    def closer(self) -> TimedEstimator:
        """See `PairEstimator`."""
        if self.estimator is None:
            return self
        out = copy.copy(self)
        out.estimator = closer(self.estimator)
        return out


def add_sequence(
    score: Score,
    frames: Sequence[SequenceRow],
    images: Sequence[RgbdFrame],
    estimator: Estimator | None,
    folder: Path | None,
    skip_explained: bool,
    known_settings: KnownSettings | None = None,
) -> None:
    """Follow one sequence, model its objects, and compare both with the ground truth.

    Args:
        score: is added to.
        frames, images: the ground truth of the sequence, and what the method is given.
        estimator: of the pairs; None for the true motions.
        folder: for meshes; None to write none.
        skip_explained: see `SequenceEstimator`.
        known_settings: of the known objects.
    """
    timed = TimedEstimator(estimator, frames, images, score)
    sequence = SequenceEstimator(timed, settings=known_settings, skip_explained=skip_explained)
    last: dict[int, int] = {}
    starts: dict[tuple[int, int], tuple[int, Float64Array]] = {}
    owners: dict[int, Counter[int]] = {}
    movers: set[int] = set()
    views: list[SequenceView] = []
    moving: list[MovingStep] = []
    known_at: dict[float, LabelImage] = {}
    sequence.update(images[0], frames[0].frame / FRAME_RATE)
    last_number = len(frames) - 1
    for number, ((prev, curr), image) in enumerate(zip(itertools.pairwise(frames), images[1:], strict=True), start=1):
        began, estimating = time.process_time(), score.estimating
        step = sequence.update(image, curr.frame / FRAME_RATE)
        assert step is not None
        score.following += time.process_time() - began - (score.estimating - estimating)
        score.pairs += 1
        if not sequence.tracker.world_T_camera:
            raise SystemExit(f"{curr.sequence}/{curr.frame}: the motion of the camera was not found")
        world_T_camera = sequence.tracker.world_T_camera[-1]
        views.append(SequenceView(number, 0, step.times[1], image, step.motion.labels, world_T_camera, step.known))
        tracks = {track.id: track for track in sequence.tracks}
        known_at |= {step.times[1]: step.known, **step.revised}
        steps = score.add_pair(prev, curr, step.motion, step.tracks, last, step.known, step.followed)
        for obj, track_id in steps:
            movers.add(obj.label)
            poses = camera_pose(prev) @ obj.prev_pose, camera_pose(curr) @ obj.curr_pose
            mask = curr.labels == obj.label
            moving.append(MovingStep(obj.label, step.times, mask, poses, obj.symmetry, track_id))
            if track_id is not None:
                owners.setdefault(track_id, Counter())[obj.label] += 1
                if (obj.label, track_id) not in starts:
                    # The track's frame is that of the object up to a rigid transform, which its first pose fixes. A
                    # track that begins with an unsure motion has no pose in the previous frame.
                    earlier, *others = tracks[track_id].world_T_object[-2:]
                    true_pose = camera_pose(prev) @ obj.prev_pose if others else camera_pose(curr) @ obj.curr_pose
                    start = geometry.inverse(earlier) @ true_pose
                    starts[obj.label, track_id] = number, start
        before = {obj.label: camera_pose(prev) @ obj.pose for obj in prev.objects}
        for true in curr.objects:
            track_id = last.get(true.label)
            if track_id is None:
                continue
            mask = curr.labels == true.label
            first, track_T_object = starts[true.label, track_id]
            pose, true_pose = tracks[track_id].world_T_object[-1] @ track_T_object, camera_pose(curr) @ true.pose
            score.tracks.add(number - first, pose, true_pose, np.zeros(3), true.symmetry)
            if number == last_number:
                score.tracks.add(END, pose, true_pose, np.zeros(3), true.symmetry)
            if rests(before[true.label], true_pose) and mask.sum() >= MIN_PIXELS:
                known = step.known == track_id
                score.rest.append(float((known & mask).sum() / (known | mask).sum()))
    score.moved += len(movers)
    add_completed(score, moving, sequence.tracks, known_at, {key: start for key, (_, start) in starts.items()})
    views = [view._replace(known=known_at[view.time]) for view in views]
    add_models(score, frames, views, sequence.tracks, owners, folder)


def add_completed(
    score: Score,
    moving: Sequence[MovingStep],
    tracks: Sequence[Track],
    known_at: Mapping[float, LabelImage],
    starts: Mapping[tuple[int, int], Float64Array],
) -> None:
    """Count the steps that are followed at the end of a sequence, at once or later.

    A step that was followed later has different poses of one track in both frames, and the known mask of that track
    covers the object. Tracks that were merged are one.
    """
    last: dict[int, int] = {}
    whole = {piece: track.id for track in tracks for piece in track.merged}
    for step in moving:
        track_id = step.track if step.track is None else whole.get(step.track, step.track)
        for track in tracks if track_id is None else ():
            if set(step.times) <= set(track.times):
                prev, curr = (track.world_T_object[track.times.index(time)] for time in step.times)
                same = best_match(step.mask, known_at[step.times[1]], {track.id: track.id})
                if same is None or np.array_equal(prev, curr):
                    continue
                track_id = same
                if (step.label, same) in starts:
                    for found, true in zip((prev, curr), step.poses, strict=True):
                        pose = found @ starts[step.label, same]
                        score.tracks.add(BEFORE, pose, true, np.zeros(3), step.symmetry)
        if track_id is not None:
            score.completed += 1
            score.completed_switches += last.get(step.label, track_id) != track_id
            last[step.label] = track_id


def rests(prev: Float64Array, curr: Float64Array) -> bool:
    """Whether an object is at rest between two frames with these poses (4, 4) in the world."""
    shift = np.linalg.norm(curr[:3, 3] - prev[:3, 3])
    turn = np.degrees(geometry.rotation_angle(prev[:3, :3].T @ curr[:3, :3]))
    return bool(shift < REST_SHIFT and turn < REST_TURN)


if __name__ == "__main__":
    main(tyro.cli(Settings))
