"""Parquet shards: written atomically and with reproducible bytes, read with random access."""

from __future__ import annotations

import io
import json
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, Generic, Literal

from objectflow.dataset.manifest import Kind, Manifest, Part, part_name
from objectflow.dataset.schema import IMAGES, PairRow, Row, SequenceRow
from objectflow.errors import DatasetError, MissingExtraError, StorageError
from objectflow.storage import files
from objectflow.storage.foreign import foreign_errors

try:
    import pyarrow as pa
    import pyarrow.parquet as pq
except ImportError as error:
    raise MissingExtraError("data sets need pyarrow, a dependency of objectflow: pip install pyarrow") from error

ROWS_PER_GROUP = 8
"""Number of rows that are read together; small, so that random access does not read whole shards."""

METADATA_KEY = b"objectflow"
"""Key of the metadata of `write_shard` in the Parquet schema."""


def write_shard(path: Path, rows: Sequence[Mapping[str, Any]], kind: Kind, metadata: Mapping[str, Any]) -> None:
    """Write rows, given by `PairRow.to_dict` or `SequenceRow.to_dict`, as a Parquet file, atomically.

    The bytes depend only on the arguments and on the version of pyarrow. Columns are not compressed, since the images
    already are.

    Args:
        path: of the shard.
        rows: in order.
        kind: which of the two row forms.
        metadata: plain JSON; returned by `read_metadata`.

    Raises:
        StorageError: writing failed; no temporary file is left behind.
    """
    schema = _SCHEMAS[kind]
    for name in ("camera_motion", "world_T_camera"):
        if any(name in row for row in rows):
            schema = schema.append(pa.field(name, _VECTOR))
    schema = schema.with_metadata({METADATA_KEY: json.dumps(metadata, sort_keys=True).encode()})
    buffer = io.BytesIO()
    pq.write_table(
        pa.Table.from_pylist(list(rows), schema=schema),
        buffer,
        row_group_size=ROWS_PER_GROUP,
        compression="none",
        use_dictionary=False,
        write_statistics=False,
    )
    files.write_bytes(path, buffer.getvalue())


def read_metadata(path: Path) -> tuple[dict[str, Any], int]:
    """The metadata that `write_shard` stored, and the number of rows.

    Raises:
        DatasetError: not a shard of objectflow.
    """
    file = _open(path)
    with foreign_errors(DatasetError, f"{path}: a Parquet file that objectflow did not write: move it away"):
        metadata = json.loads((file.schema_arrow.metadata or {})[METADATA_KEY])
        return dict(metadata), int(file.metadata.num_rows)


def read_rows(path: Path) -> list[dict[str, Any]]:
    """All rows of a shard in the form that `write_shard` takes: written again, they give the same bytes.

    Raises:
        DatasetError: not a Parquet file, or a broken one.
    """
    try:
        rows: list[dict[str, Any]] = _open(path).read().to_pylist()
    except (pa.ArrowException, OSError) as error:
        raise DatasetError(f"{path}: broken: {error}: remove it and generate it again") from error
    return rows


def read_models(path: Path) -> set[str]:
    """The names of the models in the object tables of a shard; no image is read.

    Raises:
        DatasetError: not a Parquet file, or a broken one.
    """
    try:
        column = _open(path).read(columns=["objects.list.element.model"]).column("objects")
    except (pa.ArrowException, OSError) as error:
        raise DatasetError(f"{path}: broken: {error}: remove it and generate it again") from error
    return {entry["model"] for entry in column.combine_chunks().flatten().to_pylist()}


class Shards(Sequence[Row], Generic[Row]):
    """The rows of one part of a data set, by number; files are opened when they are first needed.

    Instances can be pickled and passed to worker processes, each of which opens its own files.
    """

    def __init__(self, folder: Path, part: Part, decode: Callable[..., Row], manifest: Manifest) -> None:
        self.folder, self.part, self.manifest = folder, part, manifest
        self._decode = decode
        self._starts = [0]
        for shard in part.shards:
            path = folder / shard.file
            if not path.is_file():
                raise DatasetError(f"{path}: missing, though manifest.json lists it: copy the folder again")
            if path.stat().st_size != shard.bytes:
                raise DatasetError(
                    f"{path}: {path.stat().st_size} bytes, {shard.bytes} in manifest.json: copy the file again"
                )
            self._starts.append(self._starts[-1] + shard.rows)
        self._open: dict[int, Any] = {}
        self._group: tuple[int, int, Any] | None = None

    @property
    def where(self) -> str:
        """The part, as named in messages."""
        return f"{self.folder}: split {self.part.split!r}"

    def files(self) -> list[tuple[Path, str]]:
        """The path of every shard, and the hash that the manifest states."""
        return [(self.folder / shard.file, shard.sha256) for shard in self.part.shards]

    def __len__(self) -> int:
        return self._starts[-1]

    def __getitem__(self, index: int) -> Row:  # type: ignore[override]
        """The row of a number; negative numbers count from the end."""
        position, where = self._locate(index)
        return self._decode(self._read(position), where=where)

    def raw(self, index: int) -> tuple[dict[str, Any], str]:
        """The stored columns of a row, with images as PNG bytes, and the name of the row in messages."""
        position, where = self._locate(index)
        return self._read(position), where

    def keys(self) -> list[str]:
        """The keys of all rows ("sequence/frame" for sequences), in order, without reading images."""
        keys: list[str] = []
        for number in range(len(self.part.shards)):
            if self.part.kind == "pairs":
                found = self._column(number, "key")
            else:
                columns = (self._column(number, name) for name in ("sequence", "frame"))
                found = [f"{sequence}/{frame}" for sequence, frame in zip(*columns, strict=True)]
            if not all(isinstance(key, str) and key for key in found):
                raise DatasetError(f"{self._path(number)}: a row has no key")
            keys += found
        return keys

    def count_objects(self) -> int:
        """The total number of entries in the object tables of all rows; only the labels are read."""
        count = 0
        for number in range(len(self.part.shards)):
            with foreign_errors(DatasetError, f"{self._path(number)}: its object tables cannot be read"):
                table = self._file(number).read(columns=["objects.list.element.label"])
                count += len(table.column("objects").combine_chunks().flatten())
        return count

    def find(self, key: str) -> int:
        """The number of the row with a key.

        Raises:
            DatasetError: no such row; the message lists some existing keys.
        """
        keys = self.keys()
        if key not in keys:
            raise DatasetError(f"{self.folder}: no row {key!r}; there are {len(keys)}: {_some(keys)}")
        return keys.index(key)

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_open": {}, "_group": None}

    def _locate(self, index: int) -> tuple[int, str]:
        position = index + len(self) if index < 0 else index
        if not 0 <= position < len(self):
            raise IndexError(f"{self.folder}: row {index} of {len(self)}")
        return position, f"{self.folder}, row {position}"

    def _read(self, position: int) -> dict[str, Any]:
        number = next(i for i in range(len(self.part.shards)) if position < self._starts[i + 1])
        group, offset = divmod(position - self._starts[number], ROWS_PER_GROUP)
        if self._group is None or self._group[:2] != (number, group):
            with self._broken(number, position):
                self._group = (number, group, self._file(number).read_row_group(group))
        with self._broken(number, position):
            return dict(self._group[2].slice(offset, 1).to_pylist()[0])

    def _broken(self, number: int, position: int) -> AbstractContextManager[None]:
        return foreign_errors(
            DatasetError, f"{self._path(number)}: broken at row {position - self._starts[number]}: copy the file again"
        )

    def _column(self, number: int, name: str) -> list[Any]:
        with foreign_errors(DatasetError, f"{self._path(number)}: its column {name} cannot be read"):
            return list(self._file(number).read(columns=[name]).column(name).to_pylist())

    def _path(self, number: int) -> Path:
        return self.folder / self.part.shards[number].file

    def _file(self, number: int) -> Any:
        if number not in self._open:
            file, shard = _open(self._path(number)), self.part.shards[number]
            if file.metadata.num_rows != shard.rows:
                raise DatasetError(
                    f"{self._path(number)}: {file.metadata.num_rows} rows, {shard.rows} in manifest.json: copy the "
                    "file again"
                )
            self._open[number] = file
        return self._open[number]


def open_pairs(folder: str | Path, split: str = "train") -> Shards[PairRow]:
    """The pairs of one split.

    Raises:
        DatasetError: no data set, no such split, or a shard that is missing or of another size.
    """
    manifest, part = _part(Path(folder), split, "pairs")
    return Shards(Path(folder), part, PairRow.from_dict, manifest)


def open_sequences(folder: str | Path, split: str = "test") -> Shards[SequenceRow]:
    """The frames of one split's sequences, sequence after sequence.

    Raises:
        DatasetError: no data set, no such split, or a shard that is missing or of another size.
    """
    manifest, part = _part(Path(folder), split, "sequences")
    return Shards(Path(folder), part, SequenceRow.from_dict, manifest)


def _part(folder: Path, split: str, kind: Kind) -> tuple[Manifest, Part]:
    manifest = Manifest.read(folder)
    name = part_name(split, kind)
    if name not in manifest.parts:
        raise DatasetError(f"{folder}: no {kind} of split {split!r}; there is: {', '.join(sorted(manifest.parts))}")
    part = manifest.parts[name]
    if part.rows == 0:
        raise DatasetError(f"{folder}: split {split!r} has no {kind}")
    return manifest, part


def _open(path: Path) -> Any:
    with foreign_errors(DatasetError, f"{path}: not a Parquet file that can be read"):
        try:
            return pq.ParquetFile(path, memory_map=True)
        except FileNotFoundError:
            raise DatasetError(f"{path}: no such file") from None
        except PermissionError as error:
            raise StorageError(f"{path}: cannot be read: {error.strerror}") from error


def _some(keys: list[str]) -> str:
    return ", ".join(keys[:3]) + (f", ..., {keys[-1]}" if len(keys) > 4 else ", ".join(["", *keys[3:]]))


_VECTOR: Any = pa.list_(pa.float64())
_SYMMETRY: Any = pa.list_(pa.struct([("axis", _VECTOR), ("order", pa.int32())]))
_CAMERA: Any = pa.struct(
    [("width", pa.int32()), ("height", pa.int32())]
    + [(name, pa.float64()) for name in ("fx", "fy", "cx", "cy", "depth_scale")]
)
_IDENTITY: list[Any] = [("label", pa.int32()), ("category", pa.string()), ("model", pa.string())]
_PAIR_OBJECT: Any = pa.struct(
    _IDENTITY
    + [(name, _VECTOR) for name in ("center", "translation", "rotation_vector", "raw_rotation_vector")]
    + [("symmetry", _SYMMETRY), ("prev_pose", _VECTOR), ("curr_pose", _VECTOR), ("in_both", pa.bool_())]
)
_FRAME_OBJECT: Any = pa.struct([*_IDENTITY, ("symmetry", _SYMMETRY), ("pose", _VECTOR)])

_SCHEMAS: dict[Literal["pairs", "sequences"], Any] = {
    "pairs": pa.schema(
        [("key", pa.string()), ("scene", pa.string())]
        + [(f"{frame}_{image}", pa.binary()) for frame in ("prev", "curr") for image in IMAGES]
        + [("camera", _CAMERA), ("objects", pa.list_(_PAIR_OBJECT))]
    ),
    "sequences": pa.schema(
        [("sequence", pa.string()), ("frame", pa.int32())]
        + [(image, pa.binary()) for image in IMAGES]
        + [("camera", _CAMERA), ("objects", pa.list_(_FRAME_OBJECT))]
    ),
}
