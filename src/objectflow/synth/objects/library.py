"""The interface of every library of object models, and the sizes of its splits."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol

from objectflow.errors import DatasetError
from objectflow.synth.objects.model import ModelRef, ObjectModel

SPLIT_SIZES = {"train": 21_899, "val": 3_186, "test": 6_509}
"""Number of models per split, as many as the paper took from ShapeNet (section IV-A)."""


class Library(Protocol):
    """A source of object models."""

    @property
    def broken(self) -> Mapping[str, str]:
        """Name -> defect of every model that was left out."""
        ...

    def refs(self, split: str) -> Sequence[ModelRef]:
        """The models of a split ("train", "val" or "test") in a fixed order; splits are disjoint.

        Raises:
            DatasetError: an unknown split.
        """
        ...

    def load(self, ref: ModelRef) -> ObjectModel:
        """Build or read one model; the same reference always gives the same arrays.

        Raises:
            DatasetError: the library has no such model, or its file is broken.
        """
        ...


def check_split(split: str) -> None:
    """Check the name of a split.

    Raises:
        DatasetError: it is not train, val or test.
    """
    if split not in SPLIT_SIZES:
        raise DatasetError(f"unknown split {split!r}: choose one of {', '.join(SPLIT_SIZES)}")
