"""Convex parts of a mesh by CoACD (Wei et al. 2022), in a process of its own.

The solver prints, keeps threads and may abort on odd meshes; a child process keeps all of that away from the caller.
Run as `python -m objectflow.synth.objects.convex_parts IN.npz OUT.npz MODE`; the library calls `decompose`.
"""

from __future__ import annotations

import importlib.util
import io
import os
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from objectflow.errors import DatasetError, MissingExtraError
from objectflow.typing import Float64Array, LabelImage

MAX_PARTS = 24
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
"""CoACD's options; a coarser search than its default, which costs minutes a mesh and gains a millimetre."""
TIME_LIMIT = 600.0


def decompose(vertices: Float64Array, faces: LabelImage, name: str) -> tuple[Float64Array, ...]:
    """Convex parts of a mesh, open or closed.

    Args:
        vertices, faces: (V, 3) metres and (F, 3).
        name: what an error calls the mesh.

    Returns:
        Each (P, 3): the corners of one part. Where the solver fails on the mesh as it is and on a closed copy of it,
        the hull of the whole, with a warning that names the mesh.

    Raises:
        DatasetError: the mesh is flat.
        MissingExtraError: coacd is not installed.
    """
    if importlib.util.find_spec("coacd") is None:
        raise MissingExtraError('convex parts of a mesh need coacd: pip install "objectflow[synth]"')
    for preprocess in ("auto", "on"):  # an assertion in the solver's intersection test ends it on some closed meshes
        parts = _solve(vertices, faces, preprocess)
        if parts:
            return parts
    hull = hull_corners(vertices)
    if hull is None:
        raise DatasetError(f"{name} is flat and has no convex parts: remove it")
    warnings.warn(f"{name}: no convex parts found, its hull stands in for it in collisions", stacklevel=2)
    return (hull,)


def _solve(vertices: Float64Array, faces: LabelImage, preprocess: str) -> tuple[Float64Array, ...]:
    """Run the solver in a child process; nothing when it fails."""
    with tempfile.TemporaryDirectory(prefix="objectflow-") as folder:
        given, taken = Path(folder) / "mesh.npz", Path(folder) / "parts.npz"
        np.savez(given, vertices=vertices, faces=faces)
        command = [sys.executable, "-m", "objectflow.synth.objects.convex_parts", str(given), str(taken), preprocess]
        # One thread: the same parts whatever the machine, and no crowd when workers run side by side.
        environment = {**os.environ, "OMP_NUM_THREADS": "1"}
        try:
            done = subprocess.run(command, capture_output=True, timeout=TIME_LIMIT, env=environment, check=False)
        except subprocess.TimeoutExpired:
            return ()
        if done.returncode != 0 or not taken.is_file():
            return ()
        with np.load(taken) as data:
            return unpack(data)


def hull_corners(points: Float64Array) -> Float64Array | None:
    """The corners of a convex hull, or None where the points are flat."""
    try:
        return np.ascontiguousarray(points[ConvexHull(points).vertices])
    except QhullError:
        return None


def pack(parts: Sequence[Float64Array], **others: Float64Array) -> bytes:
    """Convex parts, and other arrays, as the bytes of one `.npz`."""
    arrays: dict[str, Any] = {**others, **{f"part{i:03d}": part for i, part in enumerate(parts)}}
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    return buffer.getvalue()


def unpack(data: Mapping[str, Float64Array]) -> tuple[Float64Array, ...]:
    """The parts of a loaded `pack`, in their order."""
    return tuple(data[name] for name in sorted(data) if name.startswith("part"))


def _main(given: str, taken: str, preprocess: str) -> None:
    import coacd

    coacd.set_log_level("error")
    with np.load(given) as data:
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
    Path(taken).write_bytes(pack(parts))


if __name__ == "__main__":
    _main(*sys.argv[1:])
