"""Read one mesh file (OBJ, STL, PLY, GLB) into triangles, texture coordinates and one texture."""

from __future__ import annotations

import hashlib
import math
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from objectflow.errors import DatasetError, MissingExtraError
from objectflow.typing import Float64Array, LabelImage, UInt8Array

SUFFIXES = (".obj", ".stl", ".ply", ".glb", ".gltf", ".off")

_TILE_SPAN = 1024
"""Side in pixels of the picture that the textures of all materials share."""
_PLAIN_GREY = (102, 102, 102)
"""What the mesh reader reports for a material without a colour."""


class MeshFile(NamedTuple):
    """A mesh as the file has it: its own units and origin."""

    vertices: Float64Array
    """(V, 3); split where texture coordinates are."""
    faces: LabelImage
    """(F, 3)."""
    uv: Float64Array
    """(V, 2)."""
    texture: UInt8Array | None
    """(h, w, 3) RGB, None where the file says nothing about colour."""

    def digest(self) -> str:
        """Hex sha256 of the geometry alone."""
        data = hashlib.sha256(np.ascontiguousarray(self.vertices).tobytes())
        data.update(np.ascontiguousarray(self.faces).tobytes())
        return data.hexdigest()


def read_mesh(path: Path) -> MeshFile:
    """Read a mesh file; several materials become one texture, and missing texture coordinates are made up.

    Raises:
        DatasetError: the file is not a mesh, or holds nothing solid (no triangles, not finite, flat).
        MissingExtraError: trimesh is not installed.
    """
    try:
        import trimesh
    except ImportError as error:
        raise MissingExtraError('reading mesh files needs trimesh: pip install "objectflow[synth]"') from error
    try:
        scene = trimesh.load(path, force="scene", process=False)
        geometries = [g for g in scene.dump() if isinstance(g, trimesh.Trimesh) and len(g.faces)]
    except MemoryError:
        raise
    except Exception as error:  # a parser of foreign bytes: whatever it trips over, the file is at fault
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise DatasetError(f"{path} is not a readable mesh ({reason}): mend or remove it") from error
    if not geometries:
        raise DatasetError(f"{path} holds no triangles: mend or remove it")
    pictures = [_picture(g, path) for g in geometries]
    coordinates = [_file_uv(g) for g in geometries]
    mesh = _combined(geometries, coordinates, pictures)
    corners = mesh.vertices[mesh.faces]
    spans = np.ptp(corners.reshape(-1, 3), axis=0)
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    if not np.isfinite(mesh.vertices).all() or not area.sum() > 0 or np.sort(spans)[1] < 1e-4 * spans.max():
        raise DatasetError(f"{path} is not a solid (points that are not finite, or all on a line): mend or remove it")
    keep = area > 0
    return mesh._replace(faces=np.ascontiguousarray(mesh.faces[keep]))


def _combined(geometries: list[Any], coordinates: list[Any], pictures: list[Any]) -> MeshFile:
    """Join the pieces; their pictures become tiles of one texture if there are several."""
    textured = any(picture is not None for picture in pictures)
    side = math.ceil(math.sqrt(len(geometries)))
    tile = _TILE_SPAN // side
    sheet = np.full((side * tile, side * tile, 3), 180, np.uint8)
    vertices, faces, uvs, start = [], [], [], 0
    for i, (geometry, given, picture) in enumerate(zip(geometries, coordinates, pictures, strict=True)):
        points = np.asarray(geometry.vertices, dtype=np.float64)
        triangles = np.asarray(geometry.faces, dtype=np.int64)
        if given is None:
            points, triangles, coordinate = _box_mapped(points, triangles)
        else:
            coordinate = given
        if textured and len(geometries) > 1:
            points, triangles, within = _within_one_tile(points, triangles, coordinate)
            row, column = divmod(i, side)
            if picture is not None:
                image = cv2.resize(picture, (tile, tile), interpolation=cv2.INTER_AREA)
                sheet[row * tile : (row + 1) * tile, column * tile : (column + 1) * tile] = image
            margin = 1.5 / tile  # keeps filtering from reaching into the neighbouring tile
            corner = np.array([column, side - 1 - row])
            coordinate = (margin + (1 - 2 * margin) * within + corner) / side
        vertices.append(points)
        faces.append(triangles + start)
        uvs.append(coordinate)
        start += len(points)
    texture = None if not textured else sheet if len(geometries) > 1 else pictures[0]
    joined = np.concatenate(faces).astype(np.int32)
    return MeshFile(np.concatenate(vertices), joined, np.concatenate(uvs), texture)


def _file_uv(geometry: Any) -> Float64Array | None:
    uv = getattr(geometry.visual, "uv", None)
    if uv is None or len(uv) != len(geometry.vertices) or not np.isfinite(uv).all():
        return None
    return np.asarray(uv, dtype=np.float64)


def _picture(geometry: Any, path: Path) -> UInt8Array | None:
    """The colour of one material as a picture: its texture, or a few pixels of its plain colour."""
    material = getattr(geometry.visual, "material", None)
    if material is None:
        return None
    colour, image_path = _mtl_materials(path).get(str(getattr(material, "name", "")), (None, None))
    if image_path is not None:
        image = cv2.imread(str(image_path), cv2.IMREAD_COLOR)
        if image is not None:
            return np.ascontiguousarray(image[..., ::-1]).astype(np.uint8)
    embedded = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
    if embedded is not None:
        return np.asarray(embedded.convert("RGB"), dtype=np.uint8)
    if colour is None and path.suffix.lower() in (".glb", ".gltf"):
        main = np.asarray(material.main_color)[:3]
        colour = None if tuple(int(c) for c in main) == _PLAIN_GREY else main.astype(np.uint8)
    return None if colour is None else np.broadcast_to(colour, (4, 4, 3)).astype(np.uint8)


def _mtl_materials(path: Path) -> dict[str, tuple[UInt8Array | None, Path | None]]:
    """Colour and texture file of each material of the `.mtl` files that an OBJ names (Wavefront's format)."""
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
            colour, image = found.get(current, (None, None))
            if key == "newmtl":
                current = value.strip()
                found[current] = (None, None)
            elif key == "Kd" and len(value.split()) >= 3:
                linear = np.array([float(word) for word in value.split()[:3]])
                found[current] = (np.clip(linear * 255, 0, 255).astype(np.uint8), image)
            elif key == "map_Kd":
                file = library.parent / value.split()[-1].replace("\\", "/")
                found[current] = (colour, file if file.is_file() else None)
    return found


def _within_one_tile(points: Any, triangles: Any, uv: Any) -> tuple[Any, Any, Any]:
    """Repeat-texturing, undone: every triangle gets its own corners, shifted to [0, 1] by whole tiles."""
    if uv.min() >= -1e-6 and uv.max() <= 1 + 1e-6:
        return points, triangles, np.clip(uv, 0, 1)
    corners = uv[triangles]
    corners = np.clip(corners - np.floor(corners.min(axis=1, keepdims=True) + 1e-9), 0, 1)
    return points[triangles].reshape(-1, 3), np.arange(triangles.size).reshape(-1, 3), corners.reshape(-1, 2)


def _box_mapped(points: Any, triangles: Any) -> tuple[Any, Any, Any]:
    """Texture coordinates by projection along each triangle's main direction; vertices split where it changes."""
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
