"""Meshes of volumes, by the marching cubes of scikit-image (Lewiner et al., 2003).

scikit-image is a wheel of 14 MB for every current Python, with pure NumPy input; Open3D would bring its own volume and
file formats, but its wheel has 400 MB.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy import ndimage
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from objectflow.errors import MissingExtraError
from objectflow.tracking.volume_grid import VolumeGrid
from objectflow.tracking.volume_surface import measured_voxels
from objectflow.typing import BoolMask, Float32Array, Float64Array, IndexArray, Int32Array, UInt8Array


class TriangleMesh(NamedTuple):
    """A coloured triangle mesh. It is open where the surface was not seen.

    Attributes:
        vertices: (V, 3) float32 metres, in the object frame.
        normals: (V, 3) float32 unit vectors out of the object.
        colors: (V, 3) uint8 RGB.
        faces: (F, 3) int32 vertex indices, counter-clockwise seen from outside.
    """

    vertices: Float32Array
    normals: Float32Array
    colors: UInt8Array
    faces: Int32Array


def check_extra() -> None:
    """Check that the libraries of the extra `models` are installed.

    Raises:
        MissingExtraError: scikit-image or trimesh is not installed.
    """
    try:
        import skimage  # noqa: F401
        import trimesh  # noqa: F401
    except ImportError as error:
        raise MissingExtraError("models need scikit-image and trimesh", "models") from error


def volume_mesh(grid: VolumeGrid, truncation: float, min_weight: float, min_component: float) -> TriangleMesh:
    """Mesh the zero crossing between voxels that were measured on both sides of the surface.

    Args:
        grid: the voxels.
        truncation: metres.
        min_weight: smallest weight of a voxel.
        min_component: smallest area of a connected piece, relative to the largest piece.

    Returns:
        The mesh; empty where nothing was measured.

    Raises:
        MissingExtraError: scikit-image is not installed.
    """
    check_extra()
    from skimage.measure import marching_cubes

    values = grid.values(truncation)
    measured = measured_voxels(grid, values, truncation, min_weight)
    if min(values.shape) < 2 or not (values[measured] < 0).any() or not (values[measured] > 0).any():
        return _empty()
    # Cubes with a corner that was not measured are left out: their faces would be invented.
    filled = np.where(measured, values, np.float32(np.nan))
    vertices, faces, _, _ = marching_cubes(filled, level=0.0, gradient_direction="descent", allow_degenerate=False)
    faces = faces[np.isfinite(vertices[faces]).all(axis=(1, 2))]
    faces = faces[_measured_faces(vertices, faces, measured)]
    faces = _large_pieces(vertices, faces, min_component)
    if not len(faces):
        return _empty()
    used, faces = np.unique(faces, return_inverse=True)
    faces = faces.reshape(-1, 3).astype(np.int32)
    vertices = vertices[used].astype(np.float64)
    colors = _colors(grid, vertices)
    points = (vertices + grid.first + 0.5) * grid.voxel
    return TriangleMesh(points.astype(np.float32), _normals(points, faces), colors, faces)


def mesh_area(mesh: TriangleMesh) -> tuple[float, float]:
    """Area of a mesh, and the least area that would close it, both in square metres.

    The area vectors of a closed surface sum to 0. What is missing has the opposite sum, and at least its length as
    area.
    """
    vectors = _area_vectors(mesh.vertices.astype(np.float64), mesh.faces)
    return float(np.linalg.norm(vectors, axis=1).sum()), float(np.linalg.norm(vectors.sum(axis=0)))


def _empty() -> TriangleMesh:
    none = np.zeros((0, 3), np.float32)
    return TriangleMesh(none, none, np.zeros((0, 3), np.uint8), np.zeros((0, 3), np.int32))


def _measured_faces(vertices: Float32Array, faces: IndexArray, measured: BoolMask) -> BoolMask:
    """(F,) bool: faces in a cube whose eight corners were measured."""
    base = np.floor(vertices[faces].mean(axis=1)).astype(np.intp)
    out = np.ones(len(faces), np.bool_)
    for offset in np.ndindex(2, 2, 2):
        i, j, k = np.minimum(base + np.array(offset), np.array(measured.shape) - 1).T
        out &= measured[i, j, k]
    return out


def _large_pieces(vertices: Float32Array, faces: IndexArray, share: float) -> IndexArray:
    """The faces of connected pieces with at least this share of the area of the largest piece."""
    if not len(faces):
        return faces
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]]])
    ones = np.ones(len(edges), np.bool_)
    _, piece = connected_components(coo_array((ones, (edges[:, 0], edges[:, 1])), shape=(len(vertices),) * 2))
    owner = piece[faces[:, 0]]
    area = np.linalg.norm(_area_vectors(vertices.astype(np.float64), faces), axis=1)
    areas = np.bincount(owner, weights=area)
    return np.asarray(faces[(areas >= share * areas.max())[owner]])


def _area_vectors(vertices: Float64Array, faces: IndexArray | Int32Array) -> Float64Array:
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    return np.asarray(0.5 * np.cross(b - a, c - a))


def _normals(vertices: Float64Array, faces: Int32Array) -> Float32Array:
    """(V, 3) means of the normals of a vertex's faces, weighted by area."""
    vectors = _area_vectors(vertices, faces)
    columns = [
        sum(np.bincount(faces[:, corner], weights=vectors[:, axis], minlength=len(vertices)) for corner in range(3))
        for axis in range(3)
    ]
    out = np.stack(columns, axis=1)
    return np.asarray(out / (np.linalg.norm(out, axis=1, keepdims=True) + 1e-20), dtype=np.float32)


def _colors(grid: VolumeGrid, vertices: Float64Array) -> UInt8Array:
    """(V, 3) colours at fractional voxel indices (V, 3), interpolated between measured voxels."""
    weight = (grid.weight > 0).astype(np.float32)
    total = ndimage.map_coordinates(weight, vertices.T, order=1, mode="nearest")
    channels = [
        ndimage.map_coordinates(grid.color[..., channel] * weight, vertices.T, order=1, mode="nearest")
        for channel in range(3)
    ]
    shades = np.stack(channels, axis=1) / np.maximum(total, 1e-6)[:, None]
    return np.clip(np.rint(shades), 0, 255).astype(np.uint8)
