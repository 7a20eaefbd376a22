"""A folder of mesh files as a library of objects: ShapeNet's layout, or any tree of OBJ, STL, PLY, GLB files."""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from objectflow.errors import DatasetError, StorageError
from objectflow.geometry.symmetry import SymmetryAxis
from objectflow.storage.archives import read_archive
from objectflow.storage.files import write_bytes, write_text
from objectflow.storage.foreign import located_errors
from objectflow.storage.temporaries import sweep
from objectflow.synth.objects.convex_parts import coarse_hull, decompose, pack, unpack
from objectflow.synth.objects.library import SPLIT_SIZES, check_split
from objectflow.synth.objects.mesh_files import SUFFIXES, read_mesh
from objectflow.synth.objects.model import ModelRef, ObjectModel
from objectflow.synth.objects.shapes.solid import signed_volume, surface_center
from objectflow.synth.objects.symmetry_detection import detect_symmetry
from objectflow.typing import Float64Array, LabelImage

SHAPENET_SYNSETS = {
    "02801938": "basket",
    "02808440": "bathtub",
    "02876657": "bottle",
    "02880940": "bowl",
    "02942699": "camera",
    "02946921": "can",
    "02954340": "cap",
    "02958343": "car",
    "02992529": "cellphone",
    "03046257": "clock",
    "03085013": "keyboard",
    "03261776": "earphone",
    "03513137": "helmet",
    "03593526": "jar",
    "03624134": "knife",
    "03636649": "lamp",
    "03642806": "laptop",
    "03691459": "loudspeaker",
    "03759954": "microphone",
    "03761084": "microwave",
    "03797390": "mug",
    "03938244": "pillow",
    "03948459": "pistol",
    "03991062": "flowerpot",
    "04074963": "remote",
    "04099429": "rocket",
    "04225987": "skateboard",
    "04401088": "telephone",
}
"""28 synsets of ShapeNetCore whose objects can lie in a pile. The paper uses 28 synsets and does not name them."""

_PLAUSIBLE_SIZES = (0.03, 0.5)
"""Range of the longest side of a tabletop object, metres; a mesh outside the range is assumed to have other units."""
_TARGET_SIZES = (0.07, 0.3)
"""Range of sizes to which such meshes are scaled, metres; as in the paper's code."""
_CACHE_VERSION = "1"
"""Part of the cache keys; it changes with the contents of the cached files."""


class MeshLibrary:
    """The meshes of a folder. Broken files are detected once, recorded in the cache, and listed in `broken`.

    In ShapeNet's layout (`synset/model/models/*.obj`) only the synsets of `SHAPENET_SYNSETS` are used. In any other
    folder every mesh file at any depth is used, and its parent folder's name is its category. Each category is divided
    into splits with the paper's shares, in the order of a hash of the names.

    Attributes:
        broken: name -> defect of every file that was left out.
    """

    broken: dict[str, str]

    def __init__(self, folder: Path, cache: Path | None = None, *, hulls: bool = False) -> None:
        """Open a folder.

        Args:
            folder: folder of the meshes.
            hulls: take the convex hull of each mesh as its only convex part instead of decomposing it, which takes
                seconds to minutes per mesh. Objects then cannot lie in hollow ones.
            cache: folder for convex parts, symmetries and the list of broken files; None for a folder in the user's
                cache.

        Raises:
            DatasetError: the folder is missing, or holds no usable mesh.
            StorageError: the cache folder cannot be written.
            MissingExtraError: reading meshes needs the extra `[synth]`.
        """
        self.folder = Path(folder)
        self._hulls = hulls
        if not self.folder.is_dir():
            raise DatasetError(f"{self.folder} is not a folder: name a folder of mesh files")
        self.cache = _user_cache() if cache is None else Path(cache)
        try:
            self.cache.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise StorageError(f"cannot make the mesh cache {self.cache}: {error.strerror}") from error
        sweep(self.cache)
        files = _mesh_files(self.folder)
        if not files:
            raise DatasetError(
                f"{self.folder} holds no meshes: it needs files ending in {', '.join(SUFFIXES)}, "
                "or ShapeNet's layout synset/model/models/*.obj"
            )
        self.broken = self._find_broken([ref.name for ref in files])
        self._refs = [ref for ref in files if ref.name not in self.broken]
        if not self._refs:
            first = next(iter(self.broken.values()))
            raise DatasetError(f"none of the {len(files)} meshes in {self.folder} can be used; the first: {first}")
        self._known = frozenset(self._refs)
        self._split_refs = _split(self._refs)

    def refs(self, split: str) -> Sequence[ModelRef]:
        """See `objectflow.synth.objects.library.Library.refs`.

        Raises:
            DatasetError: an unknown split, or one without meshes because there are too few.
        """
        check_split(split)
        if not self._split_refs[split]:
            raise DatasetError(
                f"{self.folder} has only {len(self._refs)} usable mesh(es), none of them for the split {split!r}: "
                "add meshes (three at least) or use the split 'train'"
            )
        return self._split_refs[split]

    def load(self, ref: ModelRef) -> ObjectModel:
        """See `objectflow.synth.objects.library.Library.load`. The first load of a mesh takes seconds."""
        if ref not in self._known:
            why = self.broken.get(ref.name, "there is no such file in this library")
            raise DatasetError(f"{self.folder} has no model {ref.name!r} in category {ref.category!r}: {why}")
        mesh = read_mesh(self.folder / ref.name)
        vertices = mesh.vertices * _scale(mesh.vertices, ref.name)
        vertices = vertices - surface_center(vertices, mesh.faces)
        faces = mesh.faces if signed_volume(vertices, mesh.faces) >= 0 else np.ascontiguousarray(mesh.faces[:, ::-1])
        kind = " hull" if self._hulls else ""
        key = hashlib.sha256(f"{_CACHE_VERSION} {mesh.digest()} {ref.name}{kind}".encode()).hexdigest()
        parts, symmetry = self._load_solved(key, vertices, faces, ref.name)
        return ObjectModel(ref.category, ref.name, vertices, faces, mesh.uv, parts, symmetry, mesh.texture)

    def _load_solved(
        self, key: str, vertices: Float64Array, faces: LabelImage, name: str
    ) -> tuple[tuple[Float64Array, ...], tuple[SymmetryAxis, ...]]:
        """Convex parts and symmetry from the cache; they are computed and stored there if missing."""
        path = self.cache / f"{key}.npz"
        if not path.is_file():
            parts = (coarse_hull(vertices, name),) if self._hulls else decompose(vertices, faces, name)
            symmetry = detect_symmetry(vertices, faces)
            axes = np.array([[*axis.axis, axis.order] for axis in symmetry]).reshape(-1, 4)
            write_bytes(path, pack(parts, axes=axes))
        with located_errors(DatasetError, f"the cached file {path} is damaged: remove it and start again"):
            data = read_archive(path)
            rows = data["axes"]
            return unpack(data), tuple(SymmetryAxis((float(x), float(y), float(z)), int(n)) for x, y, z, n in rows)

    def _find_broken(self, names: list[str]) -> dict[str, str]:
        """Defects by name. Files that are new or have changed since the last time are read; results are cached."""
        index = self.cache / f"folder-{hashlib.sha256(str(self.folder.resolve()).encode()).hexdigest()[:16]}.json"
        try:
            known = json.loads(index.read_text()) if index.is_file() else {}
        except (OSError, ValueError, RecursionError):
            known = {}  # a damaged index is only a lost cache: read the files again
        states: dict[str, list[Any]] = {}  # name -> [size, time of the last change, defect]
        for name in names:
            status = (self.folder / name).stat()
            state = [status.st_size, status.st_mtime_ns]
            old = known.get(name)
            states[name] = old if old is not None and old[:2] == state else [*state, _find_defect(self.folder / name)]
        if states != known:
            write_text(index, json.dumps(states))
        return {name: state[2] for name, state in states.items() if state[2]}


def _find_defect(path: Path) -> str:
    """The defect of a mesh file; empty if it is usable."""
    try:
        read_mesh(path)
    except DatasetError as error:
        return str(error)
    return ""


def _mesh_files(folder: Path) -> list[ModelRef]:
    """All meshes in a folder, at any depth, sorted by name."""
    shapenet = [
        path for path in folder.glob("*/*/models/*.obj") if re.fullmatch(r"\d{8}", path.parts[-4]) and path.is_file()
    ]
    if shapenet:
        pairs = [(SHAPENET_SYNSETS.get(path.parts[-4]), path) for path in shapenet]
        return sorted(ModelRef(kind, path.relative_to(folder).as_posix()) for kind, path in pairs if kind)
    paths = [path for path in folder.rglob("*") if path.suffix.lower() in SUFFIXES and path.is_file()]
    return sorted(
        (ModelRef(path.parent.name or folder.resolve().name, path.relative_to(folder).as_posix()) for path in paths),
        key=lambda ref: ref.name,
    )


def _split(refs: list[ModelRef]) -> dict[str, list[ModelRef]]:
    """Divide each category into splits with the paper's shares, in the order of a hash of the models' names."""
    total = sum(SPLIT_SIZES.values())
    out: dict[str, list[ModelRef]] = {split: [] for split in SPLIT_SIZES}
    for category in sorted({ref.category for ref in refs}):
        mine = sorted(
            (r for r in refs if r.category == category), key=lambda r: hashlib.sha256(r.name.encode()).digest()
        )
        least = int(len(mine) >= 3)  # three models or more leave no split empty
        counts = {s: max(round(len(mine) * SPLIT_SIZES[s] / total), least) for s in ("val", "test")}
        start = 0
        for split, count in counts.items():
            out[split] += mine[start : start + count]
            start += count
        out["train"] += mine[start:]
    return {split: sorted(models) for split, models in out.items()}


def _scale(vertices: Float64Array, name: str) -> float:
    """Scale factor of a mesh: 1 for a plausible size in metres, otherwise to a size drawn by a hash of its name."""
    size = float(np.ptp(vertices, axis=0).max())
    if _PLAUSIBLE_SIZES[0] <= size <= _PLAUSIBLE_SIZES[1]:
        return 1.0
    low, high = _TARGET_SIZES
    draw = int.from_bytes(hashlib.sha256(name.encode()).digest()[:8], "big") / 2**64
    return (low + (high - low) * draw) / size


def _user_cache() -> Path:
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "objectflow" / "meshes"
