"""`manifest.json`: the parts of a data set, the settings they were generated with, and the hash of every shard."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal, get_args

from objectflow.errors import DatasetError, StorageError
from objectflow.storage import files
from objectflow.storage.files import hash_file
from objectflow.storage.foreign import located_errors
from objectflow.storage.serialize import from_plain

FILE = "manifest.json"
VERSION = 1
"""Version of the row format and the manifest; other versions are refused."""

Kind = Literal["pairs", "sequences"]
SPLITS = ("train", "val", "test")

_RENAMED = {"wild": "clutter"}
"""Former names of presets, which older sets record as the preset and as the key of its settings."""


@dataclass(frozen=True)
class Shard:
    """One Parquet file: name, rows, size and the SHA-256 of its bytes in hexadecimal."""

    file: str
    rows: int
    bytes: int
    sha256: str

    def __post_init__(self) -> None:
        # A path would lead out of the folder, and a pipe or a device would never end.
        if not re.fullmatch(r"\w[\w.-]{0,199}", self.file, re.ASCII):
            raise DatasetError(f"the file of a shard must be a plain name, not {self.file!r}")
        if self.rows < 0 or self.bytes < 0:
            raise DatasetError(f"{self.file}: rows and bytes must be at least 0, not {self.rows} and {self.bytes}")
        if not re.fullmatch("[0-9a-f]{64}", self.sha256):
            raise DatasetError(f"{self.file}: sha256 must be 64 hexadecimal digits, not {self.sha256!r}")


@dataclass(frozen=True)
class Part:
    """All pairs, or all sequences, of one split.

    Attributes:
        kind: "pairs" or "sequences".
        split: "train", "val" or "test".
        rows: number of pairs, or of frames of sequences.
        scenes: number of simulated scenes.
        views: pairs per scene; 1 for sequences.
        rejected: number of rejected drafts of scenes, by reason.
        shards: in order.
    """

    kind: Kind
    split: str
    rows: int
    scenes: int
    views: int
    rejected: dict[str, int]
    shards: tuple[Shard, ...]

    def __post_init__(self) -> None:
        if self.kind not in get_args(Kind):
            raise DatasetError(f"the kind of a part must be pairs or sequences, not {self.kind!r}")
        if self.rows != sum(shard.rows for shard in self.shards):
            raise DatasetError(f"a part of {self.rows} rows has shards of {sum(shard.rows for shard in self.shards)}")
        if len({shard.file for shard in self.shards}) != len(self.shards):
            raise DatasetError("a part lists a shard twice")


@dataclass(frozen=True)
class Manifest:
    """A data set: its seed, settings and parts. `objectflow` is the version that generated it."""

    seed: int
    settings: dict[str, Any]
    parts: dict[str, Part]
    objectflow: str
    version: int = VERSION

    @property
    def sha256(self) -> str:
        """The hash of the whole data set, computed from the hashes of its shards."""
        return _hash_shards([shard for name in sorted(self.parts) for shard in self.parts[name].shards])

    def write(self, folder: Path) -> None:
        """Write `manifest.json` atomically.

        Raises:
            StorageError: reading or writing failed.
        """
        files.write_text(folder / FILE, json.dumps(asdict(self), indent=2, sort_keys=True) + "\n")

    @classmethod
    def read(cls, folder: Path) -> Manifest:
        """Read a data set's manifest.

        Raises:
            DatasetError: no data set, an unfinished one, or another version.
        """
        path = folder / FILE
        try:
            data = files.read_bytes(path)
        except FileNotFoundError:
            if not folder.is_dir():
                raise DatasetError(f"{folder}: no such folder") from None
            if any(folder.glob("*-of-*.parquet")):
                hint = "it is not finished: run the same `objectflow generate` command again"
            else:
                hint = "not a data set: make one with `objectflow generate`"
            raise DatasetError(f"{folder}: no {FILE}: {hint}") from None
        except OSError as error:
            raise StorageError(f"{path}: cannot be read: {error.strerror}") from error
        with located_errors(DatasetError, f"{path}: not a manifest"):
            values = json.loads(data)
            if values["version"] != VERSION:
                raise DatasetError(f"version {values['version']!r}, this program reads {VERSION}: generate it anew")
            made = from_plain(cls, values)
            return replace(made, settings=current_settings(made.settings))


def current_settings(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Recorded generator settings with all presets under their current names, so that older sets compare equal."""
    renamed = {_RENAMED.get(key, key): value for key, value in settings.items()}
    return {key: _RENAMED.get(value, value) if key == "preset" else value for key, value in renamed.items()}


def part_name(split: str, kind: Kind) -> str:
    """The name of a part, with which the names of its shards start."""
    return split if kind == "pairs" else f"{split}-sequences"


def shard_name(part: str, number: int, total: int) -> str:
    """For example "train-00000-of-00049.parquet"."""
    return f"{part}-{number:05d}-of-{total:05d}.parquet"


def verify(folder: Path, manifest: Manifest) -> int:
    """Compare the hashes of all shards with the manifest; return the number of shards.

    Raises:
        DatasetError: a shard is missing or differs.
    """
    count = 0
    for part in manifest.parts.values():
        for shard in part.shards:
            if hash_file(folder / shard.file) != shard.sha256:
                raise DatasetError(
                    f"{folder / shard.file}: its hash differs from that in {FILE}: copy the file again, "
                    "or remove it and run the same `objectflow generate` command"
                )
            count += 1
    return count


def hash_part(part: Part) -> str:
    """The hash of one part, computed from the hashes of its shards; it does not change when other parts are added."""
    return _hash_shards(part.shards)


def _hash_shards(shards: Sequence[Shard]) -> str:
    return hashlib.sha256("\n".join(shard.sha256 for shard in shards).encode()).hexdigest()
