"""Objects through time and their shapes, on generated sequences: `python benchmarks/sequences.py --data DIR`.

DIR holds sequences of `objectflow generate --out DIR --preset clutter --split test --sequences 20 --frames 30`. The
noise of a depth camera is added to their exact depth. The row `oracle` has the true masks and motions.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import tyro
from rich.console import Console
from rich.table import Table
from scipy.spatial import cKDTree

from objectflow import geometry
from objectflow.dataset.pairing import pair_of_frames
from objectflow.dataset.schema import SequenceRow
from objectflow.dataset.shards import open_sequences
from objectflow.evaluation.methods import parse_methods
from objectflow.frame import RgbdFrame
from objectflow.geometry.depth_noise import STRUCTURED_LIGHT
from objectflow.geometry.normals import surface_normals
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
from objectflow.tracking.tracker import Track, Tracker
from objectflow.tracking.volume_meshing import TriangleMesh, mesh_area
from objectflow.typing import Float64Array
from tracking import ORACLE, best_match, moved, true_motion

FRAME_RATE = 60.0
NEAR = 0.003
"""Metres: a true point this close to a vertex is covered."""
AGES = (1, 2, 5, 10, 20)
"""Numbers of frames since an object was followed first, up to which pose errors are printed."""


@dataclasses.dataclass
class Settings:
    """Follows and models objects through sequences with ground truth."""

    data: Path
    """Data set with sequences."""
    methods: tuple[str, ...] = ("rigidmatch",)
    """Methods as in `objectflow evaluate`; the oracle is always included."""
    split: str = "test"
    """Split of the data set."""
    sequences: int = 20
    """Maximum number of sequences."""
    noise: float = 1.0
    """Standard deviation of depth, in those of a structured-light camera; 0 for exact depth."""
    meshes: Path | None = None
    """Folder for the meshes; None to write none."""


@dataclasses.dataclass
class Score:
    """Sums over sequences.

    Attributes:
        visible, tracked, switches: as in `benchmarks/tracking.py`.
        shifts, turns: millimetres and degrees of the registered poses' errors, by frames since the first fused view.
        vertices: millimetres from each vertex of each model to the true surface.
        covered: share of each modelled object's seen surface within `NEAR` of its mesh.
        moved, modelled: number of objects that moved, and of those with a model.
    """

    visible: int = 0
    tracked: int = 0
    switches: int = 0
    shifts: dict[int, list[float]] = dataclasses.field(default_factory=dict)
    turns: dict[int, list[float]] = dataclasses.field(default_factory=dict)
    vertices: list[Float64Array] = dataclasses.field(default_factory=list)
    covered: list[float] = dataclasses.field(default_factory=list)
    moved: int = 0
    modelled: int = 0


def main(settings: Settings) -> None:
    rows = open_sequences(settings.data, settings.split)
    grouped = itertools.groupby((rows[k] for k in range(len(rows))), key=lambda row: row.sequence)
    sequences = [list(frames) for _, frames in itertools.islice(grouped, settings.sequences)]
    estimators: dict[str, Estimator | None] = {
        spec.label: spec.make() for spec in parse_methods(settings.methods, camera="static")
    }
    scores = {method: Score() for method in (*estimators, ORACLE)}
    for number, frames in enumerate(sequences):
        images = [noisy(row.image, settings.noise, number) for row in frames]
        for method, estimator in (estimators | {ORACLE: None}).items():
            folder = None if settings.meshes is None else settings.meshes / method / frames[0].sequence
            add_sequence(scores[method], frames, images, motions(estimator, frames, images), folder)
    console = Console(width=120)
    title = f"{len(sequences)} sequences of {len(sequences[0])} frames"
    console.print(following_table(title, scores), model_table(scores), pose_table(scores), sep="\n")


def noisy(frame: RgbdFrame, scale: float, seed: int) -> RgbdFrame:
    """The frame with normally distributed depth noise that grows with depth."""
    if scale == 0:
        return frame
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(int(frame.depth.sum()),)))
    noise = scale * STRUCTURED_LIGHT.sigma(frame.depth) * rng.standard_normal(frame.depth.shape)
    depth = np.where(frame.valid, np.maximum(frame.depth + noise, 1e-3), 0).astype(np.float32)
    return RgbdFrame(frame.color, depth, frame.camera, frame.timestamp, frame.name)


def motions(
    estimator: Estimator | None, frames: Sequence[SequenceRow], images: Sequence[RgbdFrame]
) -> Iterator[SceneMotion]:
    """The motions of all consecutive pairs; the true ones if there is no estimator."""
    for (prev, curr), (prev_image, curr_image) in zip(
        itertools.pairwise(frames), itertools.pairwise(images), strict=True
    ):
        yield true_motion(prev, curr) if estimator is None else estimator(prev_image, curr_image)


def add_sequence(
    score: Score,
    frames: Sequence[SequenceRow],
    images: Sequence[RgbdFrame],
    results: Iterator[SceneMotion],
    folder: Path | None,
) -> None:
    """Follow one sequence, model its objects, and compare both with the ground truth."""
    tracker = Tracker()
    last: dict[int, int] = {}
    owners: dict[int, Counter[int]] = {}
    movers: set[int] = set()
    views: list[SequenceView] = []
    pairs = zip(itertools.pairwise(frames), images[1:], results, strict=True)
    for number, ((prev, curr), image, motion) in enumerate(pairs, start=1):
        links = tracker.update(prev.frame / FRAME_RATE, image, curr.frame / FRAME_RATE, motion)
        views.append(SequenceView(number, 0, curr.frame / FRAME_RATE, image, motion.labels, np.eye(4)))
        for obj in pair_of_frames(prev, curr).objects:
            mask = curr.labels == obj.label
            if not moved(obj.translation) or mask.sum() < 100:
                continue
            movers.add(obj.label)
            score.visible += 1
            track_id = best_match(mask, motion.labels, links)
            if track_id is None:
                continue
            score.tracked += 1
            score.switches += obj.label in last and last[obj.label] != track_id
            last[obj.label] = track_id
            owners.setdefault(track_id, Counter())[obj.label] += 1
    score.moved += len(movers)
    add_models(score, frames, views, tracker.tracks, owners, folder)


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
    true_poses = [next(obj.pose for obj in frames[number].objects if obj.label == label) for number in model.frames]
    # The frame of the track is that of the object up to a rigid transform, which the first fused view fixes.
    true_T_model = geometry.inverse(true_poses[0]) @ model.world_T_object[0]
    vertices = geometry.transform(true_T_model, mesh.vertices.astype(np.float64))
    distance, nearest = cKDTree(points).query(vertices)
    # Pixels are a few millimetres apart: between them the surface is the nearest one's tangent plane.
    along = np.abs(((vertices - points[nearest]) * normals[nearest]).sum(axis=1))
    score.vertices.append(1000 * np.where(distance < 0.006, along, distance))
    score.covered.append(float(np.mean(np.asarray(cKDTree(vertices).query(points)[0]) < NEAR)))
    center = points.mean(axis=0)
    for number, true_pose, pose in zip(model.frames, true_poses, model.world_T_object, strict=True):
        found = pose @ geometry.inverse(true_T_model)
        shift = geometry.transform(found, center) - geometry.transform(true_pose, center)
        age = next((age for age in AGES if number - model.frames[0] <= age), AGES[-1] + 1)
        score.shifts.setdefault(age, []).append(1000 * float(np.linalg.norm(shift)))
        turn = geometry.rotation_angle(found[:3, :3].T @ true_pose[:3, :3])
        score.turns.setdefault(age, []).append(float(np.degrees(turn)))


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
    table = Table("method", "followed steps", "switches", "objects that moved", "with a model", title=title)
    for method, score in scores.items():
        share = f"{score.tracked} of {score.visible} ({score.tracked / max(1, score.visible):.0%})"
        table.add_row(method, share, str(score.switches), str(score.moved), str(score.modelled))
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
    """Median pose errors by the number of frames since the first fused view."""
    names = {age: f"<= {age}" for age in AGES} | {AGES[-1] + 1: f"> {AGES[-1]}"}
    table = Table("median pose error after", *names.values())
    for method, score in scores.items():
        cells = [
            f"{np.median(score.shifts[age]):.1f} mm {np.median(score.turns[age]):.1f} deg"
            if age in score.shifts
            else "-"
            for age in names
        ]
        table.add_row(method, *cells)
    return table


if __name__ == "__main__":
    main(tyro.cli(Settings))
