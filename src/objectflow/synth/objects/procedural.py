"""Libraries of objects: the procedural one, and the door to mesh folders."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import overload

import numpy as np
from numpy.random import Generator

from objectflow.errors import DatasetError
from objectflow.synth.objects.library import SPLIT_SIZES, Library, check_split
from objectflow.synth.objects.model import ModelRef, ObjectModel
from objectflow.synth.objects.shapes.groups import Group
from objectflow.synth.objects.shapes.household import HOUSEHOLD
from objectflow.synth.objects.shapes.solid import Solid, surface_center
from objectflow.synth.objects.shapes.tableware import TABLEWARE
from objectflow.synth.objects.shapes.tools import TOOLS

__all__ = ["CATEGORIES", "SPLIT_SIZES", "Library", "ModelRef", "ProceduralLibrary", "open_library"]

_MAKERS: dict[str, Callable[[Generator], tuple[Solid, Group]]] = dict(
    sorted({**TABLEWARE, **TOOLS, **HOUSEHOLD}.items())
)

CATEGORIES: tuple[str, ...] = tuple(_MAKERS)
"""The procedural categories, sorted; as many as the paper's 28."""


class ProceduralLibrary:
    """28 categories of everyday objects drawn by rule; a model is a category and a number.

    In each category the numbers of the train models come first, then val, then test: the splits are disjoint.
    """

    def refs(self, split: str) -> Sequence[ModelRef]:
        """See `Library.refs`; the categories take turns, so that any stretch of the list is mixed."""
        check_split(split)
        return _NumberedRefs(split)

    def load(self, ref: ModelRef) -> ObjectModel:
        """See `Library.load`."""
        category, _, number = ref.name.rpartition("-")
        if ref.category not in _MAKERS or category != ref.category or not (number.isascii() and number.isdigit()):
            raise DatasetError(
                f"the procedural library has no model {ref.name!r} in category {ref.category!r}: "
                f"a name is like mug-00012, a category one of {', '.join(CATEGORIES)}"
            )
        rng = np.random.default_rng(np.random.SeedSequence([zlib.crc32(category.encode()), int(number)]))
        solid, group = _MAKERS[category](rng)
        center = surface_center(solid.vertices, solid.faces)
        solid = solid.moved(-center)
        return ObjectModel(category, ref.name, solid.vertices, solid.faces, solid.uv, solid.parts, group)


def open_library(folder: Path | None) -> Library:
    """The procedural library for None, otherwise the meshes of a folder (see `objectflow.synth.objects.mesh_library`).

    Raises:
        DatasetError: the folder is missing or holds no meshes.
        MissingExtraError: reading meshes needs the extra `[synth]`.
    """
    if folder is None:
        return ProceduralLibrary()
    from objectflow.synth.objects.mesh_library import MeshLibrary

    return MeshLibrary(folder)


def _first_number(split: str, category: int) -> int:
    """The number with which a category's models of a split begin."""
    before = list(SPLIT_SIZES)[: list(SPLIT_SIZES).index(split)]
    return sum(_count(SPLIT_SIZES[name], category) for name in before)


def _count(size: int, category: int) -> int:
    """How many of `size` models fall to a category when all 28 take turns."""
    return size // len(CATEGORIES) + (category < size % len(CATEGORIES))


class _NumberedRefs(Sequence[ModelRef]):
    """The references of a split, made when asked for."""

    def __init__(self, split: str) -> None:
        self._size = SPLIT_SIZES[split]
        self._first = [_first_number(split, category) for category in range(len(CATEGORIES))]

    def __len__(self) -> int:
        return self._size

    @overload
    def __getitem__(self, index: int) -> ModelRef: ...

    @overload
    def __getitem__(self, index: slice) -> Sequence[ModelRef]: ...

    def __getitem__(self, index: int | slice) -> ModelRef | Sequence[ModelRef]:
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(self._size))]
        at = range(self._size)[index]
        turn, category = divmod(at, len(CATEGORIES))
        return ModelRef(CATEGORIES[category], f"{CATEGORIES[category]}-{self._first[category] + turn:05d}")
