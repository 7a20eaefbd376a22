"""Sets that can be evaluated: pairs or sequences of a generated set, the packaged tiny set, or real pair folders."""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Literal, NamedTuple, Protocol

from objectflow.dataset.manifest import FILE, hash_part
from objectflow.dataset.pairing import pair_of_frames
from objectflow.dataset.schema import PairRow, SequenceRow
from objectflow.dataset.shards import Shards, open_pairs, open_sequences
from objectflow.errors import DatasetError
from objectflow.evaluation.data.folder_pairs import TRUTH, find_pairs, read_pair
from objectflow.evaluation.data.truth import truth_of_row
from objectflow.evaluation.results import EvaluationPair
from objectflow.frame import RgbdFrame
from objectflow.storage.files import hash_file

TINY = "tiny"
TINY_FOLDER = Path(__file__).parents[1] / "tiny"
REAL = "real:"
"""Prefix of `--data` for folders of real pairs."""

SequenceUse = Literal["none", "paper", "consecutive"]

PAPER_FRAMES = (20, 80)
"""The previous and the current frame of a sequence of TestSeq; methods that take sequences get the others as well."""


class PairWindow(NamedTuple):
    """A pair within its sequence: all frames, and the indices of the previous and the current one."""

    frames: tuple[RgbdFrame, ...]
    prev: int
    curr: int


class PairSet(Protocol):
    """Pairs with their truth, by key.

    Attributes:
        data: the set's name, without a path.
        kind, split: see `Evaluation`.
        sha256: of the content.
        keys: of all pairs, in order.
    """

    data: str
    kind: str
    split: str
    sha256: str
    keys: tuple[str, ...]

    def pair(self, key: str) -> EvaluationPair:
        """The frames and the truth of a pair.

        Raises:
            DatasetError: no such pair, or one that cannot be read.
        """
        ...

    def window(self, key: str) -> PairWindow | None:
        """The sequence around the pair; None if the set has no sequences."""
        ...


def open_set(
    data: str, *, split: str = "test", sequences: SequenceUse = "none", translation_only: Collection[str] = ()
) -> PairSet:
    """Open the set that `--data` names.

    Args:
        data: "tiny"; "real:DIR" for a folder of pair folders; otherwise the folder of a generated set.
        split: of a generated set.
        sequences: take pairs from its sequences: frames 20 and 80 of each ("paper"), or all pairs of consecutive
            frames ("consecutive").
        translation_only: names of real objects whose true rotation is too inaccurate for scoring.

    Raises:
        DatasetError: no such set, or an empty one.
    """
    if data.startswith(REAL):
        if sequences != "none":
            raise DatasetError(f"{data}: pair folders hold no sequences: leave --sequences and --consecutive out")
        return FolderPairs(Path(data[len(REAL) :]), translation_only)
    if translation_only:
        raise DatasetError("--translation-only is for real pairs: rotations of a generated set are exact")
    folder = TINY_FOLDER if data == TINY else Path(data)
    if not (folder / FILE).is_file() and any(folder.glob("*/camera.json")):
        raise DatasetError(f"{folder}: pair folders, no generated set: name it {REAL}{folder}")
    if sequences == "none":
        return GeneratedPairs(open_pairs(folder, split))
    return GeneratedSequences(open_sequences(folder, split), sequences)


class GeneratedPairs:
    """The pairs of one split of a generated set; see `PairSet`."""

    kind = "pairs"

    def __init__(self, shards: Shards[PairRow]) -> None:
        self.data, self.split = shards.folder.resolve().name, shards.part.split
        self.sha256 = hash_part(shards.part)
        self._shards = shards
        keys = shards.keys()
        self._index = {key: index for index, key in enumerate(keys)}
        self.keys = tuple(self._index)
        _check_unique(self.keys, len(shards), shards.folder)

    def pair(self, key: str) -> EvaluationPair:
        """See `PairSet`."""
        row = self._shards[_index_of(key, self._index, self.data)]
        return EvaluationPair(row.prev, row.curr, truth_of_row(row))

    def window(self, key: str) -> PairWindow | None:
        """See `PairSet`."""
        return None


class GeneratedSequences:
    """Pairs of frames of one split's sequences; see `PairSet`.

    Raises:
        DatasetError: a sequence without the paper's two frames.
    """

    def __init__(self, shards: Shards[SequenceRow], use: SequenceUse) -> None:
        self.data, self.split = shards.folder.resolve().name, shards.part.split
        self.kind = "sequences" if use == "paper" else "consecutive"
        self.sha256 = hash_part(shards.part)
        self._shards = shards
        self._rows: dict[str, list[int]] = {}
        """Rows of each sequence."""
        self._places: dict[str, tuple[str, int, int]] = {}
        """Sequence of each key, and the indices of its two frames in it."""
        keys = shards.keys()
        names = [key.rpartition("/") for key in keys]
        for row, (sequence, _, _) in enumerate(names):
            self._rows.setdefault(sequence, []).append(row)
        for sequence, rows in self._rows.items():
            frames = [int(names[row][2]) for row in rows]
            if use == "paper":
                if not set(PAPER_FRAMES) <= set(frames):
                    raise DatasetError(
                        f"{shards.folder}: sequence {sequence} has frames {frames}, not both of {PAPER_FRAMES}: "
                        "use --consecutive"
                    )
                places = [(frames.index(PAPER_FRAMES[0]), frames.index(PAPER_FRAMES[1]))]
            else:
                places = [(place, place + 1) for place in range(len(rows) - 1)]
            for prev, curr in places:
                self._places[f"{sequence}/{frames[curr]}"] = (sequence, prev, curr)
        self.keys = tuple(self._places)

    def pair(self, key: str) -> EvaluationPair:
        """See `PairSet`."""
        sequence, prev, curr = self._place(key)
        rows = self._rows[sequence]
        row = pair_of_frames(self._shards[rows[prev]], self._shards[rows[curr]])
        return EvaluationPair(row.prev, row.curr, truth_of_row(row))

    def window(self, key: str) -> PairWindow:
        """See `PairSet`."""
        sequence, prev, curr = self._place(key)
        return PairWindow(tuple(self._shards[row].image for row in self._rows[sequence]), prev, curr)

    def _place(self, key: str) -> tuple[str, int, int]:
        if key not in self._places:
            raise DatasetError(f"{self.data}: no pair {key!r}")
        return self._places[key]


class FolderPairs:
    """The pair folders with a truth in a folder; see `PairSet`."""

    kind = "real"
    split = ""

    def __init__(self, folder: Path, translation_only: Collection[str] = ()) -> None:
        paths = [path for path in find_pairs(folder) if (path / TRUTH).is_file()]
        if not paths:
            raise DatasetError(f"{folder}: none of its pairs has a {TRUTH} to be scored against")
        self._translation_only = frozenset(translation_only)
        self._paths = {path.name: path for path in paths}
        self.keys = tuple(self._paths)
        self.data = folder.resolve().name
        self.sha256 = _hash_folders(paths)

    def pair(self, key: str) -> EvaluationPair:
        """See `PairSet`."""
        if key not in self._paths:
            raise DatasetError(f"{self.data}: no pair {key!r}")
        real = read_pair(self._paths[key], translation_only=self._translation_only)
        if real.truth is None:
            raise DatasetError(f"{self._paths[key]}: its {TRUTH} was removed")
        return EvaluationPair(real.prev, real.curr, real.truth)

    def window(self, key: str) -> PairWindow | None:
        """See `PairSet`."""
        return None


_PARTS = frozenset({"color0", "color1", "depth0", "depth1", "camera", "truth"})


def _hash_folders(folders: Sequence[Path]) -> str:
    """Hash of the names and bytes of the files of pairs, without other files in their folders."""
    digest = hashlib.sha256()
    for folder in folders:
        for path in sorted(folder.iterdir()):
            if path.stem in _PARTS and path.is_file():
                digest.update(f"{folder.name}/{path.name} {hash_file(path)}\n".encode())
    return digest.hexdigest()


def _index_of(key: str, index: dict[str, int], data: str) -> int:
    if key not in index:
        raise DatasetError(f"{data}: no pair {key!r}")
    return index[key]


def _check_unique(keys: tuple[str, ...], rows: int, folder: Path) -> None:
    if len(keys) != rows:
        raise DatasetError(f"{folder}: {rows} rows with {len(keys)} different keys: generate the set anew")
