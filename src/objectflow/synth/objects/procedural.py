"""The procedural library: 28 categories of everyday objects."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Mapping, Sequence
from typing import overload

import numpy as np
from numpy.random import Generator

from objectflow.errors import DatasetError
from objectflow.synth.objects.library import SPLIT_SIZES, check_split
from objectflow.synth.objects.model import ModelRef, ObjectModel
from objectflow.synth.objects.shapes.groups import Group
from objectflow.synth.objects.shapes.household import HOUSEHOLD
from objectflow.synth.objects.shapes.solid import Solid, surface_center
from objectflow.synth.objects.shapes.tableware import TABLEWARE
from objectflow.synth.objects.shapes.tools import TOOLS

_SHAPES: dict[str, Callable[[Generator], tuple[Solid, Group]]] = dict(
    sorted({**TABLEWARE, **TOOLS, **HOUSEHOLD}.items())
)

CATEGORIES: tuple[str, ...] = tuple(_SHAPES)
"""The procedural categories, sorted; as many as the paper's 28."""


class ProceduralLibrary:
    """28 categories of procedural objects; a model is identified by a category and a number.

    In each category the train models have the lowest numbers, then val, then test, so that splits are disjoint.
    """

    broken: Mapping[str, str] = {}
    """See `Library.broken`; procedural models are never broken."""

    def refs(self, split: str) -> Sequence[ModelRef]:
        """See `Library.refs`; categories alternate, so that every section of the list is mixed."""
        check_split(split)
        return _NumberedRefs(split)

    def load(self, ref: ModelRef) -> ObjectModel:
        """See `Library.load`."""
        category, _, number = ref.name.rpartition("-")
        if ref.category not in _SHAPES or category != ref.category or not (number.isascii() and number.isdigit()):
            raise DatasetError(
                f"the procedural library has no model {ref.name!r} in category {ref.category!r}: "
                f"a name is like mug-00012, a category one of {', '.join(CATEGORIES)}"
            )
        rng = np.random.default_rng(np.random.SeedSequence([zlib.crc32(category.encode()), int(number)]))
        solid, group = _SHAPES[category](rng)
        center = surface_center(solid.vertices, solid.faces)
        solid = solid.moved(-center)
        return ObjectModel(category, ref.name, solid.vertices, solid.faces, solid.uv, solid.parts, group)


def _first_number(split: str, category: int) -> int:
    """The lowest number of a category's models in a split."""
    before = list(SPLIT_SIZES)[: list(SPLIT_SIZES).index(split)]
    return sum(_count(SPLIT_SIZES[name], category) for name in before)


def _count(size: int, category: int) -> int:
    """Number of models of one category among `size` models of alternating categories."""
    return size // len(CATEGORIES) + (category < size % len(CATEGORIES))


class _NumberedRefs(Sequence[ModelRef]):
    """The references of a split, created on access."""

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
        offset, category = divmod(at, len(CATEGORIES))
        return ModelRef(CATEGORIES[category], f"{CATEGORIES[category]}-{self._first[category] + offset:05d}")
