"""Objects through time and their shapes, on generated sequences: `python benchmarks/sequences.py --data DIR`.

DIR holds sequences of `objectflow generate --out DIR --preset clutter --split test --sequences 20 --frames 30`. The
noise of a depth camera is added to their exact depth. The row `oracle` has the true masks and motions. For sequences
with a moving camera (`--camera-turn 1 --camera-shift 0.005`), add `--camera moving`.
"""

from __future__ import annotations

import dataclasses
import itertools
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import tyro
from rich.console import Console
from rich.table import Table
from scipy.spatial import cKDTree

from objectflow import geometry
from objectflow.dataset.schema import SequenceRow
from objectflow.dataset.shards import open_sequences
from objectflow.evaluation.methods import parse_methods
from objectflow.frame import RgbdFrame
from objectflow.geometry.depth_noise import STRUCTURED_LIGHT
from objectflow.geometry.normals import surface_normals
from objectflow.geometry.symmetry import SymmetryAxis, reduce_motion
from objectflow.methods.base import Estimator
from objectflow.motion import SceneMotion
from objectflow.storage import files
from objectflow.tracking.model_files import ply_bytes
from objectflow.tracking.reconstruction import (
    ObjectModel,
    ReconstructionSettings,
    SequenceView,
    fuse_objects,
    missing_reason,
)
from objectflow.tracking.sequence_estimator import SequenceEstimator
from objectflow.tracking.track import Track
from objectflow.tracking.volume_meshing import TriangleMesh, mesh_area
from objectflow.typing import BoolMask, Float64Array, LabelImage
from tracking import FRAME_RATE, MIN_PIXELS, ORACLE, FollowedSteps, best_match, true_motion

NEAR = 0.003
"""Metres: a true point this close to a vertex is covered."""
AGES = (1, 2, 5, 10, 20)
"""Numbers of frames since an object was followed first, up to which pose errors are printed."""
END = 10_000
"""Key of the pose errors in the last frame of each sequence."""
BEFORE = -1
"""Key of the errors of poses that were found later, by following an object back."""
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
    meshes: Path | None = None
    """Folder for the meshes; None to write none."""


@dataclasses.dataclass
class PoseErrors:
    """Errors of poses by the number of frames since an object was followed first.

    Attributes:
        shifts, turns: millimetres and degrees.
    """

    shifts: dict[int, list[float]] = dataclasses.field(default_factory=dict)
    turns: dict[int, list[float]] = dataclasses.field(default_factory=dict)

    def add(
        self,
        age: int,
        found: Float64Array,
        true: Float64Array,
        center: Float64Array,
        symmetry: Sequence[SymmetryAxis] = (),
    ) -> None:
        """Add a pose.

        Args:
            age: frames since the first one, or `BEFORE` or `END`.
            found, true: (4, 4) poses in one frame.
            center: (3,) metres in the object's true frame: the point at which the shift is measured. The axes of
                symmetry pass through its origin.
            symmetry: of the object; a turn within it is no error.
        """
        group = age if age in (BEFORE, END) else next((limit for limit in AGES if age <= limit), AGES[-1] + 1)
        shift = geometry.transform(found, center) - geometry.transform(true, center)
        self.shifts.setdefault(group, []).append(1000 * float(np.linalg.norm(shift)))
        turn = geometry.rotation_angle(reduce_motion(found[:3, :3], true[:3, :3], symmetry))
        self.turns.setdefault(group, []).append(float(np.degrees(turn)))


@dataclasses.dataclass
class Score(FollowedSteps):
    """Sums over sequences; see `FollowedSteps`.

    Attributes:
        tracks: errors of the tracks' poses in every frame since the object was followed first, also at rest.
        models: errors of the poses that reconstruction registered, since the first fused view.
        rest: IoU of the known mask of each object at rest that was followed before.
        vertices: millimetres from each vertex of each model to the true surface.
        covered: share of each modelled object's seen surface within `NEAR` of its mesh.
        moved, modelled: number of objects that moved, and of those with a model.
        pairs: number of pairs.
        estimating, following: CPU seconds of the method in consecutive frames, and of everything else but the models'
            fusion: the method between frames farther apart belongs to the latter.
        completed, completed_switches: `tracked` and `switches` after the end of each sequence, when objects have been
            followed back.
    """

    tracks: PoseErrors = dataclasses.field(default_factory=PoseErrors)
    models: PoseErrors = dataclasses.field(default_factory=PoseErrors)
    rest: list[float] = dataclasses.field(default_factory=list)
    vertices: list[Float64Array] = dataclasses.field(default_factory=list)
    covered: list[float] = dataclasses.field(default_factory=list)
    moved: int = 0
    modelled: int = 0
    pairs: int = 0
    estimating: float = 0.0
    following: float = 0.0
    completed: int = 0
    completed_switches: int = 0


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
        for method, estimator in (estimators | {ORACLE: None}).items():
            folder = None if settings.meshes is None else settings.meshes / method / frames[0].sequence
            add_sequence(scores[method], frames, images, between(estimator, frames, images), folder)
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


def between(
    estimator: Estimator | None, frames: Sequence[SequenceRow], images: Sequence[RgbdFrame]
) -> Callable[[int, int], SceneMotion]:
    """The motion between two frames of these numbers, the earlier one first; the true one if there is no estimator."""
    if estimator is None:
        return lambda prev, curr: true_motion(frames[prev], frames[curr])
    return lambda prev, curr: estimator(images[prev], images[curr])


def add_sequence(
    score: Score,
    frames: Sequence[SequenceRow],
    images: Sequence[RgbdFrame],
    estimate_between: Callable[[int, int], SceneMotion],
    folder: Path | None,
) -> None:
    """Follow one sequence, model its objects, and compare both with the ground truth."""
    numbers = {id(image): number for number, image in enumerate(images)}

    def estimate(prev: RgbdFrame, curr: RgbdFrame) -> SceneMotion:
        began = time.process_time()
        found = estimate_between(numbers[id(prev)], numbers[id(curr)])
        if numbers[id(curr)] == numbers[id(prev)] + 1:
            score.estimating += time.process_time() - began
        return found

    sequence = SequenceEstimator(estimate)
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
                    # The track's frame is that of the object up to a rigid transform, which the first step fixes.
                    start = geometry.inverse(tracks[track_id].world_T_object[-2]) @ camera_pose(prev) @ obj.prev_pose
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


def camera_pose(row: SequenceRow) -> Float64Array:
    """(4, 4) `world_T_camera`; the world is the camera of the sequence's first frame."""
    return np.eye(4) if row.world_T_camera is None else row.world_T_camera


def rests(prev: Float64Array, curr: Float64Array) -> bool:
    """Whether an object is at rest between two frames with these poses (4, 4) in the world."""
    shift = np.linalg.norm(curr[:3, 3] - prev[:3, 3])
    turn = np.degrees(geometry.rotation_angle(prev[:3, :3].T @ curr[:3, :3]))
    return bool(shift < REST_SHIFT and turn < REST_TURN)


def add_models(
    score: Score,
    frames: Sequence[SequenceRow],
    views: Sequence[SequenceView],
    tracks: Sequence[Track],
    owners: dict[int, Counter[int]],
    folder: Path | None,
) -> None:
    """Model the tracks of true objects; of several tracks of one object, the one that follows it longest counts."""
    settings = ReconstructionSettings()
    chosen: dict[int, int] = {}
    for track_id, counts in owners.items():
        label, steps = counts.most_common(1)[0]
        if label not in chosen or steps > owners[chosen[label]][label]:
            chosen[label] = track_id
    labels = {track_id: label for label, track_id in chosen.items()}
    for model in fuse_objects(views, [track for track in tracks if track.id in labels], settings):
        mesh = model.volume.mesh()
        if missing_reason(model, mesh_area(mesh)[0], settings):
            continue
        score.modelled += 1
        add_model(score, frames, model, mesh, labels[model.id])
        if folder is not None:
            folder.mkdir(parents=True, exist_ok=True)
            name = f"{labels[model.id]:03d}.ply"
            files.write_bytes(folder / name, ply_bytes(mesh.vertices, mesh.normals, mesh.colors, mesh))


def add_model(score: Score, frames: Sequence[SequenceRow], model: ObjectModel, mesh: TriangleMesh, label: int) -> None:
    """Compare one model with the exact depth of its object in all frames, carried into the object's true frame."""
    points, normals = true_surface(frames, label)
    true = [next(obj for obj in frames[number].objects if obj.label == label) for number in model.frames]
    true_poses = [camera_pose(frames[number]) @ obj.pose for number, obj in zip(model.frames, true, strict=True)]
    # The frame of the track is that of the object up to a rigid transform, which the first fused view fixes.
    true_T_model = geometry.inverse(true_poses[0]) @ model.world_T_object[0]
    vertices = geometry.transform(true_T_model, mesh.vertices.astype(np.float64))
    distance, nearest = cKDTree(points).query(vertices)
    # Pixels are a few millimetres apart: between them the surface is the nearest one's tangent plane.
    along = np.abs(((vertices - points[nearest]) * normals[nearest]).sum(axis=1))
    score.vertices.append(1000 * np.where(distance < 0.006, along, distance))
    score.covered.append(float(np.mean(np.asarray(cKDTree(vertices).query(points)[0]) < NEAR)))
    model_T_true = geometry.inverse(true_T_model)
    for number, true_pose, pose in zip(model.frames, true_poses, model.world_T_object, strict=True):
        score.models.add(number - model.frames[0], pose @ model_T_true, true_pose, np.zeros(3), true[0].symmetry)


def true_surface(frames: Sequence[SequenceRow], label: int) -> tuple[Float64Array, Float64Array]:
    """(N, 3) points and normals of an object that the camera saw in any frame, in the object's true frame."""
    points, normals = [], []
    for row in frames:
        facing = surface_normals(row.image.depth, row.image.camera)
        mask = (row.labels == label) & np.isfinite(facing[..., 2])
        pose = next(obj.pose for obj in row.objects if obj.label == label)
        own = geometry.back_project(row.image.depth, row.image.camera)[mask].astype(np.float64)
        points.append(geometry.transform(geometry.inverse(pose), own))
        normals.append(facing[mask].astype(np.float64) @ pose[:3, :3])
    return np.concatenate(points), np.concatenate(normals)


def following_table(title: str, scores: dict[str, Score]) -> Table:
    columns = (
        "method", "followed at once", "switches", "in the end", "switches", "IoU at rest, median", "mean",
        "objects that moved", "modelled",
    )  # fmt: skip
    table = Table(*columns, title=title)
    for method, score in scores.items():
        once, end = (
            f"{count} of {score.visible} ({count / max(1, score.visible):.0%})"
            for count in (score.tracked, score.completed)
        )
        rest = (f"{np.median(score.rest):.2f}", f"{np.mean(score.rest):.2f}") if score.rest else ("-", "-")
        table.add_row(
            method, once, str(score.switches), end, str(score.completed_switches), *rest, str(score.moved),
            str(score.modelled),
        )  # fmt: skip
    return table


def model_table(scores: dict[str, Score]) -> Table:
    table = Table("method", "vertex error mm, median", "90% below", "median model", "seen surface covered, median")
    for method, score in scores.items():
        if not score.vertices:
            table.add_row(method, "-", "-", "-", "-")
            continue
        every = np.concatenate(score.vertices)
        middle = float(np.median([np.median(one) for one in score.vertices]))
        table.add_row(
            method,
            f"{np.median(every):.2f}",
            f"{np.quantile(every, 0.9):.2f}",
            f"{middle:.2f}",
            f"{np.median(score.covered):.2f}",
        )
    return table


def pose_table(scores: dict[str, Score]) -> Table:
    """Median pose errors by the number of frames since an object was followed first."""
    names = (
        {BEFORE: "followed back"}
        | {age: f"<= {age}" for age in AGES}
        | {AGES[-1] + 1: f"> {AGES[-1]}", END: "at the end"}
    )
    table = Table("median pose error after", *names.values())
    for method, score in scores.items():
        for kind, errors in (("track", score.tracks), ("model", score.models)):
            cells = [
                f"{np.median(errors.shifts[age]):.1f} mm {np.median(errors.turns[age]):.1f} deg"
                if age in errors.shifts
                else "-"
                for age in names
            ]
            table.add_row(f"{method}, {kind}", *cells)
    return table


def time_table(scores: dict[str, Score]) -> Table:
    table = Table("method", "CPU s a pair", "tracks and known objects", "together / method alone")
    for method, score in scores.items():
        alone, more = score.estimating / score.pairs, score.following / score.pairs
        ratio = "-" if method == ORACLE else f"{(alone + more) / alone:.2f}"
        table.add_row(method, f"{alone:.2f}", f"{more:.2f}", ratio)
    return table


if __name__ == "__main__":
    main(tyro.cli(Settings))
