"""The page's data of a run in 3D: simplified models, their poses over time, and the points of the background."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from objectflow.errors import ResultError
from objectflow.tracking.model_files import MODELS
from objectflow.tracking.track import Track
from objectflow.tracking.volume_meshing import check_extra
from objectflow.typing import Float64Array, Int64Array, UInt8Array
from objectflow.view.colors import object_color
from objectflow.view.report_page.packing import pack_bytes, pack_words
from objectflow.view.run_page.contents import ReportFrame, RunContents, model_poses

MAX_VERTICES = 10_000
"""Largest number of vertices of a model in the page; larger meshes are simplified by merging vertices."""
MAX_BACKGROUND = 25_000
"""Largest number of points of the background in the page; larger clouds are subsampled evenly."""
STEP = 0.0005
"""Metres: quantisation step of the background's points and the smallest one of a model."""
GROWTH = 1.2
"""Factor by which the cells of the simplification grow until few enough vertices are left."""


class PageMesh(NamedTuple):
    """A coloured mesh.

    Attributes:
        vertices: (V, 3) metres, in the object frame.
        colors: (V, 3) uint8 RGB.
        faces: (F, 3) vertex indices.
    """

    vertices: Float64Array
    colors: UInt8Array
    faces: Int64Array


def model_block(run: RunContents, track: Track, entry: Mapping[str, Any]) -> dict[str, Any]:
    """The JSON data of one model.

    Raises:
        MissingExtraError: trimesh is not installed.
        ResultError: the file is missing or damaged.
    """
    mesh = simplify(read_mesh(run.folder / MODELS / str(entry["files"][0])), MAX_VERTICES)
    lower = mesh.vertices.min(axis=0)
    step = max(STEP / 10, float(np.ptp(mesh.vertices, axis=0).max()) / 32767)
    return {
        "id": track.id,
        "color": object_color(track.id),
        "lower": [round(float(value), 6) for value in lower],
        "step": step,
        "vertices": pack_words(_planes(np.rint((mesh.vertices - lower) / step).astype(np.int16))),
        "colors": pack_bytes(mesh.colors),
        "faces": pack_words(_planes(mesh.faces.astype(np.uint16).view(np.int16))),
    }


def scene_block(run: RunContents, part: int, with_models: Sequence[int]) -> dict[str, Any]:
    """The JSON data of the objects' poses in one part of the run, and of its background.

    Args:
        run: the run.
        part: whose world is shown.
        with_models: ids of the objects whose models are in the page.

    Raises:
        MissingExtraError: there is a background, but trimesh is not installed.
        ResultError: the background is missing or damaged.
    """
    frames = run.part(part)
    block: dict[str, Any] = {
        "frames": [frame.number for frame in frames],
        "words": [frame_words(frame, frames[0], run.has_times) for frame in frames],
        "objects": [_poses(run, track, frames) for track in run.tracks if run.part_of(track) == part],
        "models": list(with_models),
        "background": None,
    }
    entry = run.models.get("background")
    if entry and entry["points"]:
        points, colors, _ = read_mesh(run.folder / MODELS / str(entry["file"]))
        pick = np.linspace(0, len(points) - 1, min(len(points), MAX_BACKGROUND)).round().astype(int)
        words = np.clip(np.rint(points[pick] / STEP), -32767, 32767).astype(np.int16)
        spacing = float(entry["voxel"]) * np.sqrt(len(points) / len(pick))
        block["background"] = {
            "step": STEP,
            "spacing": round(spacing, 5),
            "points": pack_words(_planes(words)),
            "colors": pack_bytes(colors[pick]),
        }
    return block


def frame_words(frame: ReportFrame, first: ReportFrame, has_times: bool) -> str:
    """Number and time of a frame, for display."""
    return f"frame {frame.number}" + (f", {frame.time - first.time:.2f} s" if has_times else "")


def _poses(run: RunContents, track: Track, frames: Sequence[ReportFrame]) -> dict[str, Any]:
    times, poses = track.times, model_poses(track, run.model(track.id))
    index = {frame.time: k for k, frame in enumerate(frames)}
    return {
        "id": track.id,
        "color": object_color(track.id),
        "frames": [index[time] for time in times if time in index],
        "poses": [
            [round(float(value), 6) for value in pose[:3].ravel()]
            for time, pose in zip(times, poses, strict=True)
            if time in index
        ],
    }


def _planes(rows: NDArray[np.int16]) -> NDArray[np.int16]:
    """(N, 3) -> (3, N), whose consecutive differences are small."""
    return np.ascontiguousarray(rows.T)


def read_mesh(path: Path) -> PageMesh:
    """Read a mesh or a point cloud with colours.

    Raises:
        MissingExtraError: trimesh is not installed.
        ResultError: the file is missing or damaged.
    """
    check_extra()
    import trimesh

    try:
        found = trimesh.load(path, process=False)
        faces = getattr(found, "faces", np.zeros((0, 3)))
        colors = found.visual.vertex_colors if hasattr(found, "faces") else found.colors
        return PageMesh(
            np.asarray(found.vertices, dtype=np.float64),
            np.ascontiguousarray(np.asarray(colors, dtype=np.uint8)[:, :3]),
            np.asarray(faces, dtype=np.int64),
        )
    except (OSError, ValueError, IndexError, KeyError, AttributeError, TypeError) as error:
        raise ResultError(f"{path}: not a model of a run: {error}; `objectflow reconstruct` writes it anew") from error


def simplify(mesh: PageMesh, max_vertices: int) -> PageMesh:
    """Merge the vertices in each cell of a grid, whose cells grow until at most `max_vertices` are left.

    Faces with two corners in one cell are dropped.
    """
    if len(mesh.vertices) <= max_vertices:
        return mesh
    lower = mesh.vertices.min(axis=0)
    cell = float(np.ptp(mesh.vertices, axis=0).max()) / 512
    while True:
        cells = np.floor((mesh.vertices - lower) / cell).astype(np.int64)
        _, inverse, counts = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
        if len(counts) <= max_vertices:
            break
        cell *= GROWTH
    inverse = inverse.ravel()
    sums = np.zeros((len(counts), 6))
    np.add.at(sums, inverse, np.hstack([mesh.vertices, mesh.colors]))
    means = sums / counts[:, None]
    faces = inverse[mesh.faces]
    keep = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    return PageMesh(means[:, :3], np.rint(means[:, 3:]).astype(np.uint8), faces[keep])
