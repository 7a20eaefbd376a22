"""Convex parts of a mesh by CoACD (Wei et al. 2022), in a child process.

The solver prints, leaves threads running and may abort on irregular meshes; a child process isolates the caller.
Run as `python -m objectflow.synth.objects.convex_parts MODE PARENT`, with the mesh on its standard input and the parts
on its standard output, so that a kill leaves no file; the library calls `decompose`.
"""

from __future__ import annotations

import importlib.util
import io
import os
import subprocess
import sys
import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from objectflow.errors import DatasetError, MissingExtraError
from objectflow.runtime.parent import end_with_parent
from objectflow.typing import Float64Array, LabelImage

MAX_PARTS = 24
"""Maximum number of convex parts of a mesh."""
SETTINGS = {
    "threshold": 0.06,
    "max_convex_hull": MAX_PARTS,
    "preprocess_resolution": 40,
    "resolution": 1000,
    "mcts_iterations": 60,
    "mcts_nodes": 12,
    "decimate": True,
    "max_ch_vertex": 48,
    "seed": 0,
}
"""CoACD options; its default search takes minutes per mesh and is only a millimetre more accurate."""
HULL_DIRECTIONS = 96
"""Number of directions whose extreme points represent a convex hull."""
TIME_LIMIT = 600.0
"""Maximum time per mesh, seconds."""


def decompose(vertices: Float64Array, faces: LabelImage, name: str) -> tuple[Float64Array, ...]:
    """Compute the convex parts of a mesh, which may be open.

    Args:
        vertices, faces: (V, 3) metres and (F, 3).
        name: name of the mesh in messages.

    Returns:
        Each (P, 3): the corners of one part, metres. If the solver fails on both the mesh and a closed copy of it, the
        hull of the whole mesh, with a warning that names it.

    Raises:
        DatasetError: the mesh is flat.
        MissingExtraError: coacd is not installed.
    """
    if importlib.util.find_spec("coacd") is None:
        raise MissingExtraError("convex parts of a mesh need coacd", "synth")
    for preprocess in ("auto", "on"):  # the solver fails an assertion on some closed meshes
        parts = run_solver(vertices, faces, preprocess)
        if parts:
            return parts
    hull = hull_corners(vertices)
    if hull is None:
        raise DatasetError(f"{name} is flat and has no convex parts: remove it")
    warnings.warn(f"{name}: no convex parts found; its convex hull is used in collisions", stacklevel=2)
    return (hull,)


def run_solver(vertices: Float64Array, faces: LabelImage, preprocess: str) -> tuple[Float64Array, ...]:
    """Run the solver in a child process; return no parts if it fails.

    Args:
        vertices, faces: see `decompose`.
        preprocess: whether CoACD closes the mesh first: "auto" or "on".
    """
    mesh = io.BytesIO()
    np.savez(mesh, vertices=vertices, faces=faces)
    command = [sys.executable, "-m", "objectflow.synth.objects.convex_parts", preprocess, str(os.getpid())]
    # One thread gives the same parts on every machine, and parallel workers do not compete for cores.
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    try:
        done = subprocess.run(
            command, input=mesh.getvalue(), capture_output=True, timeout=TIME_LIMIT, env=environment, check=False
        )
    except subprocess.TimeoutExpired:
        return ()
    if done.returncode != 0 or not done.stdout:
        return ()
    with np.load(io.BytesIO(done.stdout)) as data:
        return unpack(data)


def hull_corners(points: Float64Array) -> Float64Array | None:
    """The corners (C, 3) of the convex hull of points (P, 3), or None if the points are coplanar."""
    try:
        return np.ascontiguousarray(points[ConvexHull(points).vertices])
    except QhullError:
        return None


def coarse_hull(points: Float64Array, name: str) -> Float64Array:
    """The corners (C, 3) of a convex hull of points (P, 3) that are extreme in one of `HULL_DIRECTIONS` directions.

    Raises:
        DatasetError: the points are coplanar.
    """
    i = np.arange(HULL_DIRECTIONS)
    z = 1 - (2 * i + 1) / HULL_DIRECTIONS  # a Fibonacci lattice on the sphere
    angle, radius = i * np.pi * (3 - np.sqrt(5)), np.sqrt(1 - z**2)
    directions = np.stack([radius * np.cos(angle), radius * np.sin(angle), z])
    corners = hull_corners(points[np.unique((points @ directions).argmax(axis=0))])
    if corners is None:
        raise DatasetError(f"{name} is flat and has no convex parts: remove it")
    return corners


def pack(parts: Sequence[Float64Array], **others: Float64Array) -> bytes:
    """Serialize convex parts and further named arrays as the bytes of one `.npz`."""
    arrays: dict[str, Any] = {**others, **{f"part{i:03d}": part for i, part in enumerate(parts)}}
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    return buffer.getvalue()


def unpack(data: Mapping[str, Float64Array]) -> tuple[Float64Array, ...]:
    """The convex parts of a loaded `pack`, in order."""
    return tuple(data[name] for name in sorted(data) if name.startswith("part"))


def _main(preprocess: str, parent: str) -> None:
    end_with_parent(int(parent))
    # What the solver prints must not mix with the parts.
    output = os.dup(1)
    os.dup2(2, 1)
    import coacd

    coacd.set_log_level("error")
    with np.load(io.BytesIO(sys.stdin.buffer.read())) as data:
        vertices, faces = data["vertices"], data["faces"]
    welded, index = np.unique(vertices, axis=0, return_inverse=True)
    faces = index.reshape(-1)[faces]
    solid = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 0] != faces[:, 2])
    found = coacd.run_coacd(coacd.Mesh(welded, faces[solid]), preprocess_mode=preprocess, **SETTINGS)
    parts = [
        corners for points, _ in found if (corners := hull_corners(np.asarray(points, dtype=np.float64))) is not None
    ]
    if not parts:
        raise SystemExit(3)
    with open(output, "wb") as file:
        file.write(pack(parts))


if __name__ == "__main__":
    _main(*sys.argv[1:])
