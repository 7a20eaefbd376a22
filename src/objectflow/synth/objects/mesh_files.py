"""Reads one mesh file (OBJ, STL, PLY, GLB) into triangles, texture coordinates and one texture."""

from __future__ import annotations

import hashlib
import math
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from objectflow.errors import DatasetError, MissingExtraError, ReaderError
from objectflow.runtime.quiet import silence_stderr
from objectflow.storage.foreign import foreign_errors
from objectflow.storage.image_files import read_photograph
from objectflow.typing import Float64Array, LabelImage, UInt8Array

SUFFIXES = (".obj", ".stl", ".ply", ".glb", ".gltf", ".off")

_ATLAS_SIZE = 1024
"""Side length of the texture atlas of all materials, pixels."""
_DEFAULT_COLOR = (102, 102, 102)
"""RGB colour that trimesh reports for a material without a colour."""


class MeshFile(NamedTuple):
    """A mesh in the file's own units and frame."""

    vertices: Float64Array
    """(V, 3); split at texture seams."""
    faces: LabelImage
    """(F, 3)."""
    uv: Float64Array
    """(V, 2)."""
    texture: UInt8Array | None
    """(h, w, 3) RGB; None if the file has no colours."""

    def digest(self) -> str:
        """Hexadecimal SHA-256 of the geometry alone."""
        data = hashlib.sha256(np.ascontiguousarray(self.vertices).tobytes())
        data.update(np.ascontiguousarray(self.faces).tobytes())
        return data.hexdigest()


def read_mesh(path: Path) -> MeshFile:
    """Read a mesh file. Several materials become one texture; missing texture coordinates are box-projected.

    Raises:
        DatasetError: the file is not a mesh, or not a solid (no triangles, not finite, collinear).
        MissingExtraError: trimesh is not installed.
    """
    try:
        import trimesh  # noqa: F401
    except ImportError as error:
        raise MissingExtraError("reading mesh files needs trimesh", "synth") from error
    with silence_stderr(), foreign_errors(DatasetError, f"{path} is not a readable mesh: repair or remove it"):
        return _read(path)


def _read(path: Path) -> MeshFile:
    import trimesh

    scene = trimesh.load(path, force="scene", process=False)
    geometries = [g for g in scene.dump() if isinstance(g, trimesh.Trimesh) and len(g.faces)]
    if not geometries:
        raise DatasetError(f"{path} holds no triangles: repair or remove it")
    images = [_material_image(g, path) for g in geometries]
    coordinates = [_file_uv(g) for g in geometries]
    mesh = _combine(geometries, coordinates, images)
    corners = mesh.vertices[mesh.faces]
    spans = np.ptp(corners.reshape(-1, 3), axis=0)
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    if not np.isfinite(mesh.vertices).all() or not area.sum() > 0 or np.sort(spans)[1] < 1e-4 * spans.max():
        raise DatasetError(f"{path} is not a solid (not finite, or all points on a line): repair or remove it")
    keep = area > 0
    return mesh._replace(faces=np.ascontiguousarray(mesh.faces[keep]))


def _combine(geometries: list[Any], coordinates: list[Any], images: list[Any]) -> MeshFile:
    """Join the pieces of a mesh; several textures become the tiles of an atlas."""
    textured = any(image is not None for image in images)
    side = math.ceil(math.sqrt(len(geometries)))
    tile = _ATLAS_SIZE // side
    atlas = np.full((side * tile, side * tile, 3), 180, np.uint8)
    vertices, faces, uvs, start = [], [], [], 0
    for i, (geometry, given, image) in enumerate(zip(geometries, coordinates, images, strict=True)):
        points = np.asarray(geometry.vertices, dtype=np.float64)
        triangles = np.asarray(geometry.faces, dtype=np.int64)
        if given is None:
            points, triangles, coordinate = _box_projection(points, triangles)
        else:
            coordinate = given
        if textured and len(geometries) > 1:
            points, triangles, within = _unwrap_repeats(points, triangles, coordinate)
            row, column = divmod(i, side)
            if image is not None:
                resized = cv2.resize(image, (tile, tile), interpolation=cv2.INTER_AREA)
                atlas[row * tile : (row + 1) * tile, column * tile : (column + 1) * tile] = resized
            margin = 1.5 / tile  # texture filtering must not reach the neighbouring tile
            corner = np.array([column, side - 1 - row])
            coordinate = (margin + (1 - 2 * margin) * within + corner) / side
        vertices.append(points)
        faces.append(triangles + start)
        uvs.append(coordinate)
        start += len(points)
    texture = None if not textured else atlas if len(geometries) > 1 else images[0]
    joined = np.concatenate(faces).astype(np.int32)
    return MeshFile(np.concatenate(vertices), joined, np.concatenate(uvs), texture)


def _file_uv(geometry: Any) -> Float64Array | None:
    uv = getattr(geometry.visual, "uv", None)
    if uv is None or len(uv) != len(geometry.vertices) or not np.isfinite(uv).all():
        return None
    return np.asarray(uv, dtype=np.float64)


def _material_image(geometry: Any, path: Path) -> UInt8Array | None:
    """The texture of one material, (h, w, 3) RGB; a few equal pixels for a plain colour."""
    material = getattr(geometry.visual, "material", None)
    if material is None:
        return None
    color, image_path = _mtl_materials(path).get(str(getattr(material, "name", "")), (None, None))
    if image_path is not None:
        with suppress(ReaderError):  # a mesh is usable without its texture
            return read_photograph(image_path)
    embedded = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
    if embedded is not None:
        return np.asarray(embedded.convert("RGB"), dtype=np.uint8)
    if color is None and path.suffix.lower() in (".glb", ".gltf"):
        main = np.asarray(material.main_color)[:3]
        color = None if tuple(int(c) for c in main) == _DEFAULT_COLOR else main.astype(np.uint8)
    return None if color is None else np.broadcast_to(color, (4, 4, 3)).astype(np.uint8)


def _mtl_materials(path: Path) -> dict[str, tuple[UInt8Array | None, Path | None]]:
    """Colour and texture file of each material in the `.mtl` files (Wavefront format) of an OBJ file."""
    found: dict[str, tuple[UInt8Array | None, Path | None]] = {}
    if path.suffix.lower() != ".obj":
        return found
    with open(path, encoding="utf-8", errors="replace") as lines:
        names = [line.split(maxsplit=1)[1].strip() for line in lines if line.startswith("mtllib ")]
    for name in names:
        library = path.parent / name
        if not library.is_file():
            continue
        current = ""
        for line in library.read_text(encoding="utf-8", errors="replace").splitlines():
            key, _, value = line.strip().partition(" ")
            color, image = found.get(current, (None, None))
            if key == "newmtl":
                current = value.strip()
                found[current] = (None, None)
            elif key == "Kd" and len(value.split()) >= 3:
                linear = np.array([float(word) for word in value.split()[:3]])
                found[current] = (np.clip(linear * 255, 0, 255).astype(np.uint8), image)
            elif key == "map_Kd":
                file = library.parent / value.split()[-1].replace("\\", "/")
                found[current] = (color, file if file.is_file() else None)
    return found


def _unwrap_repeats(points: Any, triangles: Any, uv: Any) -> tuple[Any, Any, Any]:
    """Undo texture repetition: give every triangle its own corners, shifted to [0, 1] by whole tiles."""
    if uv.min() >= -1e-6 and uv.max() <= 1 + 1e-6:
        return points, triangles, np.clip(uv, 0, 1)
    corners = uv[triangles]
    corners = np.clip(corners - np.floor(corners.min(axis=1, keepdims=True) + 1e-9), 0, 1)
    return points[triangles].reshape(-1, 3), np.arange(triangles.size).reshape(-1, 3), corners.reshape(-1, 2)


def _box_projection(points: Any, triangles: Any) -> tuple[Any, Any, Any]:
    """Texture coordinates by projection along each triangle's dominant axis; vertices are split where it changes."""
    _, first, merged = np.unique(points, axis=0, return_index=True, return_inverse=True)
    points, triangles = points[first], merged.reshape(-1)[triangles]
    a, b, c = (points[triangles[:, i]] for i in range(3))
    main = np.abs(np.cross(b - a, c - a)).argmax(axis=1)
    low, span = points.min(axis=0), max(float(np.ptp(points, axis=0).max()), 1e-12)
    keys, index = np.unique((triangles + main[:, None] * len(points)).ravel(), return_inverse=True)
    axis, vertex = np.divmod(keys, len(points))
    flat = (points[vertex] - low) / span
    others = np.array([[1, 2], [0, 2], [0, 1]])[axis]
    uv = np.take_along_axis(flat, others, axis=1)
    return points[vertex], index.reshape(-1, 3), uv
