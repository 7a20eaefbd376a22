"""The concatenation of several data sets."""

from __future__ import annotations

import bisect
import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from objectflow.dataset.schema import PairRow
from objectflow.dataset.shards import Shards, open_pairs
from objectflow.errors import DatasetError


class JoinedPairs(Sequence[PairRow]):
    """The pairs of several parts under one numbering; keys start with the name of their folder."""

    def __init__(self, parts: Sequence[Shards[PairRow]]) -> None:
        """Concatenate parts.

        Args:
            parts: at least one.

        Raises:
            DatasetError: no part, or the same folder twice.
        """
        folders = [part.folder.resolve() for part in parts]
        if not parts or len(set(folders)) < len(folders):
            raise DatasetError(f"data sets to be joined must be different folders, not {_listed(folders)}")
        self.parts = tuple(parts)
        self._starts = list(itertools.accumulate((len(part) for part in parts), initial=0))

    @property
    def where(self) -> str:
        """The parts, as named in messages."""
        return ", ".join(part.where for part in self.parts)

    def __len__(self) -> int:
        return self._starts[-1]

    def __getitem__(self, index: int) -> PairRow:  # type: ignore[override]
        """The row of a number; negative numbers count from the end."""
        part, own = self._locate(index)
        return part[own]

    def raw(self, index: int) -> tuple[dict[str, Any], str]:
        """See `Shards.raw`."""
        part, own = self._locate(index)
        return part.raw(own)

    def keys(self) -> list[str]:
        """The keys of all rows, in order, each after the name of its folder."""
        names = [(part.folder.name, part.keys()) for part in self.parts]
        return [f"{name}/{key}" for name, keys in names for key in keys]

    def count_objects(self) -> int:
        """See `Shards.count_objects`."""
        return sum(part.count_objects() for part in self.parts)

    def files(self) -> list[tuple[Path, str]]:
        """See `Shards.files`."""
        return [file for part in self.parts for file in part.files()]

    def _locate(self, index: int) -> tuple[Shards[PairRow], int]:
        position = index + len(self) if index < 0 else index
        if not 0 <= position < len(self):
            raise IndexError(f"{self.where}: row {index} of {len(self)}")
        number = bisect.bisect_right(self._starts, position) - 1
        return self.parts[number], position - self._starts[number]


Pairs = Shards[PairRow] | JoinedPairs
"""Training data: one part, or several."""


def open_joined(folders: Sequence[Path], split: str) -> Pairs:
    """The pairs of one split of one or more data sets.

    Raises:
        DatasetError: as for `open_pairs`, or the same folder twice.
    """
    parts = [open_pairs(folder, split) for folder in folders]
    return parts[0] if len(parts) == 1 else JoinedPairs(parts)


def _listed(folders: Sequence[Path]) -> str:
    return ", ".join(str(folder) for folder in folders) or "none"
