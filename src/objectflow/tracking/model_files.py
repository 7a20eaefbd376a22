"""Models on disk: `models/object_001.ply` and `.glb`, `models/background.ply` and `models/index.json`."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from objectflow.storage import files
from objectflow.tracking.background import BackgroundCloud
from objectflow.tracking.reconstruction import ObjectModel, ReconstructionSettings, missing_reason
from objectflow.tracking.volume_meshing import TriangleMesh, mesh_area
from objectflow.tracking.volume_surface import SurfacePoints
from objectflow.typing import Float32Array, UInt8Array

MODELS = "models"
INDEX = "index.json"
BACKGROUND = "background.ply"
FORMAT = 1
"""Version of `index.json`."""

_VERTEX = np.dtype(
    [(name, "<f4") for name in ("x", "y", "z", "nx", "ny", "nz")]
    + [(name, "|u1") for name in ("red", "green", "blue")]
)
_FACE = np.dtype([("count", "|u1"), ("corners", "<i4", 3)])


def write_models(
    folder: Path,
    models: Sequence[ObjectModel],
    background: BackgroundCloud,
    settings: ReconstructionSettings,
) -> tuple[list[int], dict[int, str]]:
    """Write the folder `models`, whole; an earlier one is replaced.

    Args:
        folder: of the run.
        models: fused objects.
        background: the static rest.
        settings: of the reconstruction, stored with the models.

    Returns:
        The ids of the objects with a model, and the reason for each object without one.

    Raises:
        MissingExtraError: scikit-image or trimesh is not installed.
        StorageError: a file cannot be written.
    """
    entries: list[dict[str, Any]] = []
    reasons: dict[int, str] = {}
    with files.new_folder(folder / MODELS, replace=True) as temporary:
        for model in models:
            mesh = model.volume.mesh()
            area, opening = mesh_area(mesh)
            reason = missing_reason(model, area, settings)
            if reason:
                reasons[model.id] = reason
                continue
            name = f"object_{model.id:03d}"
            files.write_bytes(temporary / f"{name}.ply", ply_bytes(mesh.vertices, mesh.normals, mesh.colors, mesh))
            files.write_bytes(temporary / f"{name}.glb", glb_bytes(mesh))
            entries.append(_entry(model, mesh, name, area, opening))
        points = background.points()
        files.write_bytes(temporary / BACKGROUND, ply_bytes(*points))
        index = {
            "format": FORMAT,
            "frame": "world = camera of the first frame; meshes lie in their object's frame",
            "objects": entries,
            "without_model": [{"id": number, "reason": reason} for number, reason in reasons.items()],
            "background": _background_entry(background, points),
            "settings": settings.to_dict(),
        }
        files.write_text(temporary / INDEX, json.dumps(index, indent=2) + "\n")
    return [entry["id"] for entry in entries], reasons


def ply_bytes(
    points: Float32Array, normals: Float32Array, colors: UInt8Array, mesh: TriangleMesh | None = None
) -> bytes:
    """A binary PLY file.

    Args:
        points: (N, 3) metres.
        normals: (N, 3) unit vectors.
        colors: (N, 3) RGB.
        mesh: its faces are written; None for a point cloud.
    """
    vertices = np.zeros(len(points), _VERTEX)
    for axis, name in enumerate("xyz"):
        vertices[name], vertices[f"n{name}"] = points[:, axis], normals[:, axis]
    for channel, name in enumerate(("red", "green", "blue")):
        vertices[name] = colors[:, channel]
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(points)}"]
    lines += [f"property float {name}" for name in ("x", "y", "z", "nx", "ny", "nz")]
    lines += [f"property uchar {name}" for name in ("red", "green", "blue")]
    content = vertices.tobytes()
    if mesh is not None:
        faces = np.zeros(len(mesh.faces), _FACE)
        faces["count"], faces["corners"] = 3, mesh.faces
        lines += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
        content += faces.tobytes()
    return ("\n".join([*lines, "end_header"]) + "\n").encode("ascii") + content


def glb_bytes(mesh: TriangleMesh) -> bytes:
    """A binary glTF file with normals and vertex colours, in metres and in the axes of the object's frame."""
    import trimesh

    out = trimesh.Trimesh(
        mesh.vertices, mesh.faces, vertex_normals=mesh.normals, vertex_colors=mesh.colors, process=False
    )
    return bytes(out.export(file_type="glb", include_normals=True))


def _entry(model: ObjectModel, mesh: TriangleMesh, name: str, area: float, opening: float) -> dict[str, Any]:
    lower, upper = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    residual = float(np.median(model.residuals)) if model.residuals else None
    grid = model.volume.grid
    return {
        "id": model.id,
        "files": [f"{name}.ply", f"{name}.glb"],
        "frames": model.frames,
        "times": model.times,
        "world_T_object": [pose.tolist() for pose in model.world_T_object],
        "views_not_fused": model.rejected,
        "lower": [round(float(value), 6) for value in lower],
        "extent": [round(float(value), 6) for value in upper - lower],
        "area": round(area, 8),
        "seen_share_at_most": round(area / (area + opening), 4),
        "residual_mm": None if residual is None else round(1000 * residual, 3),
        "voxel": None if grid is None else grid.voxel,
        "vertices": len(mesh.vertices),
        "faces": len(mesh.faces),
    }


def _background_entry(background: BackgroundCloud, points: SurfacePoints) -> dict[str, Any]:
    return {
        "file": BACKGROUND,
        "frames": background.frames,
        "points": len(points.points),
        "voxel": background.voxel,
    }
