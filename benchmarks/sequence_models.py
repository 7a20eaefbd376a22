"""Models of the objects of a sequence against their true surfaces."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from objectflow import geometry
from objectflow.dataset.schema import SequenceRow
from objectflow.geometry.normals import surface_normals
from objectflow.storage import files
from objectflow.tracking.model_files import ply_bytes
from objectflow.tracking.reconstruction import (
    ObjectModel,
    ReconstructionSettings,
    SequenceView,
    fuse_objects,
    missing_reason,
)
from objectflow.tracking.track import Track
from objectflow.tracking.volume_meshing import TriangleMesh, mesh_area
from objectflow.typing import Float64Array
from sequence_scores import Score
from tracking import camera_pose

NEAR = 0.003
"""Metres: a true point this close to a vertex is covered."""


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
