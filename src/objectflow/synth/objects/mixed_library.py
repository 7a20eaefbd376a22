"""Procedural objects, the meshes of a folder, or a mixture of both."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import overload

from objectflow.errors import DatasetError
from objectflow.synth.objects.library import SPLIT_SIZES, Library, check_split
from objectflow.synth.objects.mesh_library import MeshLibrary
from objectflow.synth.objects.model import ModelRef, ObjectModel
from objectflow.synth.objects.procedural import ProceduralLibrary

_PERIOD = 100
"""Length of the repeating pattern of meshes and other models in the list of references."""


@dataclass(frozen=True)
class MeshFolder:
    """A folder of meshes and its use.

    Attributes:
        folder: see `objectflow.synth.objects.mesh_library.MeshLibrary`.
        share: share of objects that are meshes, above 0 and at most 1; the others are procedural.
        every: put all meshes into every split, for a test set of shapes that are in no training set.
        hulls: use the convex hull of each mesh in collisions instead of a decomposition.
    """

    folder: Path
    share: float = 1.0
    every: bool = False
    hulls: bool = False

    def __post_init__(self) -> None:
        if not 0 < self.share <= 1:
            raise DatasetError(f"the share of meshes must be above 0 and at most 1, not {self.share}")


def open_library(meshes: MeshFolder | None) -> Library:
    """Open the library for a mesh folder, or the procedural library for None.

    Raises:
        DatasetError: the folder is missing or holds no meshes.
        MissingExtraError: reading meshes needs the extra `[synth]`.
    """
    if meshes is None:
        return ProceduralLibrary()
    library = MeshLibrary(meshes.folder, hulls=meshes.hulls)
    if meshes.share == 1 and not meshes.every:
        return library
    return MixedLibrary(library, ProceduralLibrary(), meshes.share, every=meshes.every)


class MixedLibrary:
    """Two libraries as one; see `objectflow.synth.objects.library.Library`."""

    def __init__(self, meshes: Library, others: Library, share: float, *, every: bool) -> None:
        self._meshes, self._others, self._share, self._every = meshes, others, share, every
        self.broken = meshes.broken
        self._known = {ref for split in SPLIT_SIZES for ref in self._mesh_refs(split)}

    def refs(self, split: str) -> Sequence[ModelRef]:
        """See `Library.refs`."""
        check_split(split)
        meshes = self._mesh_refs(split)
        if not meshes:
            raise DatasetError(f"no mesh for the split {split!r}: add meshes (three at least) or use --every-mesh")
        return meshes if self._share == 1 else _MixedRefs(meshes, self._others.refs(split), self._share)

    def load(self, ref: ModelRef) -> ObjectModel:
        """See `Library.load`."""
        return (self._meshes if ref in self._known else self._others).load(ref)

    def _mesh_refs(self, split: str) -> list[ModelRef]:
        wanted = SPLIT_SIZES if self._every else (split,)
        found: list[ModelRef] = []
        for name in wanted:
            try:
                found += self._meshes.refs(name)
            except DatasetError:  # too few meshes for this split
                continue
        return found


class _MixedRefs(Sequence[ModelRef]):
    """References with a constant share of meshes in every period; both lists are repeated as often as needed."""

    def __init__(self, meshes: Sequence[ModelRef], others: Sequence[ModelRef], share: float) -> None:
        self._meshes, self._others = meshes, others
        self._first = max(1, round(share * _PERIOD))

    def __len__(self) -> int:
        return _PERIOD * max(len(self._others), len(self._meshes))

    @overload
    def __getitem__(self, index: int) -> ModelRef: ...

    @overload
    def __getitem__(self, index: slice) -> Sequence[ModelRef]: ...

    def __getitem__(self, index: int | slice) -> ModelRef | Sequence[ModelRef]:
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(len(self)))]
        period, place = divmod(range(len(self))[index], _PERIOD)
        if place < self._first:
            return self._meshes[(period * self._first + place) % len(self._meshes)]
        return self._others[(period * (_PERIOD - self._first) + place - self._first) % len(self._others)]
