"""What every library of object models offers, and the sizes of its splits."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from objectflow.errors import DatasetError
from objectflow.synth.objects.model import ModelRef, ObjectModel

SPLIT_SIZES = {"train": 21_899, "val": 3_186, "test": 6_509}
"""Models in each split, as many as the paper took from ShapeNet (section IV-A)."""


class Library(Protocol):
    """Where objects come from."""

    def refs(self, split: str) -> Sequence[ModelRef]:
        """The models of a split ("train", "val" or "test"), in a fixed order; splits share none.

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
    """Refuse a split that is none.

    Raises:
        DatasetError: it is not train, val or test.
    """
    if split not in SPLIT_SIZES:
        raise DatasetError(f"unknown split {split!r}: choose one of {', '.join(SPLIT_SIZES)}")
