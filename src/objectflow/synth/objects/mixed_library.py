"""Meshes of a folder instead of the procedural objects, or mixed with them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import overload

from objectflow.errors import DatasetError
from objectflow.synth.objects.library import SPLIT_SIZES, Library, check_split
from objectflow.synth.objects.model import ModelRef, ObjectModel
from objectflow.synth.objects.procedural import ProceduralLibrary, open_library

_TURNS = 100
"""Of so many references in a row, a share are meshes."""


@dataclass(frozen=True)
class Meshes:
    """A folder of meshes and its use.

    Attributes:
        folder: see `objectflow.synth.objects.mesh_library.MeshLibrary`.
        share: of the objects that are meshes; the others are procedural.
        every: every split has all of them, for a test set of shapes that nothing was trained on.
    """

    folder: Path
    share: float = 1.0
    every: bool = False

    def __post_init__(self) -> None:
        if not 0 < self.share <= 1:
            raise DatasetError(f"the share of meshes must be above 0 and at most 1, not {self.share}")


class MixedLibrary:
    """Two libraries as one; see `objectflow.synth.objects.library.Library`."""

    def __init__(self, meshes: Library, others: Library, share: float, *, every: bool) -> None:
        self._meshes, self._others, self._share, self._every = meshes, others, share, every
        self.broken: dict[str, str] = getattr(meshes, "broken", {})
        self._known = {ref for split in SPLIT_SIZES for ref in self._mesh_refs(split)}

    def refs(self, split: str) -> Sequence[ModelRef]:
        """See `Library.refs`."""
        check_split(split)
        meshes = self._mesh_refs(split)
        if not meshes:
            raise DatasetError(f"no mesh for the split {split!r}: add meshes (three at least), or take every one")
        return meshes if self._share == 1 else _Mixed(meshes, self._others.refs(split), self._share)

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


def open_mixed(meshes: Meshes | None) -> Library:
    """The library that the settings name; the procedural one for None.

    Raises:
        DatasetError: the folder is missing or holds no meshes.
        MissingExtraError: reading meshes needs the extra `[synth]`.
    """
    if meshes is None:
        return ProceduralLibrary()
    library = open_library(meshes.folder)
    if meshes.share == 1 and not meshes.every:
        return library
    return MixedLibrary(library, ProceduralLibrary(), meshes.share, every=meshes.every)


class _Mixed(Sequence[ModelRef]):
    """Any stretch holds the share of meshes; both lists are gone through again and again."""

    def __init__(self, meshes: Sequence[ModelRef], others: Sequence[ModelRef], share: float) -> None:
        self._meshes, self._others = meshes, others
        self._first = max(1, round(share * _TURNS))

    def __len__(self) -> int:
        return _TURNS * max(len(self._others), len(self._meshes))

    @overload
    def __getitem__(self, index: int) -> ModelRef: ...

    @overload
    def __getitem__(self, index: slice) -> Sequence[ModelRef]: ...

    def __getitem__(self, index: int | slice) -> ModelRef | Sequence[ModelRef]:
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(len(self)))]
        turn, place = divmod(range(len(self))[index], _TURNS)
        if place < self._first:
            return self._meshes[(turn * self._first + place) % len(self._meshes)]
        return self._others[(turn * (_TURNS - self._first) + place - self._first) % len(self._others)]
