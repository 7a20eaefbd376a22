"""Bags as doors: by bytes, by records, by messages, and by the metadata of ROS 2."""

from __future__ import annotations

import random
import shutil
import sqlite3
import struct
import tempfile
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from fuzz import mutations
from fuzz.doors import CAMERA, Door, Read, color, depth, frames_of
from helpers.bags import COLOR, DEPTH, INFO, BagBuilder, Kind, write_frames
from objectflow import RgbdFrame

KINDS: tuple[Kind, ...] = ("ros1", "sqlite3", "mcap")
SUFFIXES = {"ros1": ".bag", "sqlite3": ".db3", "mcap": ".mcap"}
FIELDS = ("height", "width", "encoding", "step", "data", "k", "K", "d", "D", "format")
"""Fields of images and camera infos that are changed."""
FIELDS = ("height", "width", "encoding", "step", "data", "k", "K", "d", "D", "format")
"""Fields of images and camera infos that are changed."""
MCAP_START = 8
"""Length of the magic bytes at the start of an MCAP file."""


@cache
def valid_bag(kind: Kind) -> dict[str, bytes]:
    """The files of a bag of three frames: one for ROS 1, a data file and metadata.yaml for the others."""
    frames = [RgbdFrame(color(i), depth(i).astype(np.float32) / 1000, CAMERA) for i in range(3)]
    with tempfile.TemporaryDirectory() as folder:
        path = write_frames(Path(folder) / f"bag{'.bag' if kind == 'ros1' else ''}", frames, kind)
        return _files_of(path)


def bag_bytes(rng: random.Random, folder: Path) -> Read:
    kind = rng.choice(KINDS)
    contents = dict(valid_bag(kind))
    name = _data_file(contents)
    contents[name] = mutations.bytes_of(rng, contents[name])
    return _written(contents, kind, folder, alone=rng.random() < 0.5)


def bag_records(rng: random.Random, folder: Path) -> Read:
    kind = rng.choice(KINDS)
    contents = dict(valid_bag(kind))
    name = _data_file(contents)
    if kind == "sqlite3":
        contents[name] = _changed_table(rng, contents[name])
    else:
        start, records = _split_mcap(contents[name]) if kind == "mcap" else _split_ros1(contents[name])
        contents[name] = start + b"".join(_changed_records(rng, records))
    return _written(contents, kind, folder, alone=rng.random() < 0.5)


def bag_messages(rng: random.Random, folder: Path) -> Read | None:
    kind = rng.choice(KINDS)
    bag = BagBuilder(kind)
    for index in range(3):
        seconds = 1000.0 + index / 10
        bag.image(COLOR, seconds, color(index), "rgb8")
        bag.image(DEPTH, seconds, depth(index), "16UC1")
        bag.info(INFO, seconds, RgbdFrame(color(index), depth(index).astype(np.float32) / 1000, CAMERA))
        bag.compressed(f"{COLOR}/compressed", seconds, b"\x89PNG", rng.choice(mutations.TEXTS))
    for _ in range(rng.choice((1, 2, 5))):
        message = rng.choice(bag.messages)[-1]
        name = rng.choice([name for name in FIELDS if hasattr(message, name)])
        old = getattr(message, name)
        if isinstance(old, np.ndarray):
            new: Any = np.resize(old, rng.choice((0, 1, old.size // 2, old.size * 2)) if name == "data" else old.size)
            if old.dtype.kind == "f":
                new = np.full_like(new, rng.choice((np.nan, np.inf, 0, -1, 1e308)))
        elif isinstance(old, str):
            encodings = ("16UC1", "32FC1", "rgb8", "bayer_rggb8", "mono16", "yuv422", "8UC255", "64FC9")
            new = rng.choice((*encodings, *mutations.TEXTS))
        else:
            new = rng.choice((0, 1, 2, old - 1, old + 1, old * 2, 2**31 - 1, 2**32 - 1))
        setattr(message, name, new) if not type(message).__dataclass_params__.frozen else (
            object.__setattr__(message, name, new)
        )
    try:
        path = bag.write(folder / f"bag{SUFFIXES['ros1'] if kind == 'ros1' else ''}")
    except (struct.error, ValueError, TypeError, UnicodeError, AssertionError, OverflowError):
        shutil.rmtree(folder, ignore_errors=True)
        return None
    return frames_of(path)


def metadata_yaml(rng: random.Random, folder: Path) -> Read:
    kind: Kind = rng.choice(("sqlite3", "mcap"))
    contents = dict(valid_bag(kind))
    data = contents["metadata.yaml"]
    if rng.random() < 0.3:
        contents["metadata.yaml"] = mutations.bytes_of(rng, data)
    else:
        contents["metadata.yaml"] = mutations.lines_of(rng, data.decode()).encode("utf-8", "surrogatepass")
    return _written(contents, kind, folder, alone=False)


def _files_of(path: Path) -> dict[str, bytes]:
    found = [path] if path.is_file() else sorted(path.iterdir())
    return {file.name: file.read_bytes() for file in found}


def _data_file(contents: dict[str, bytes]) -> str:
    return next(name for name in contents if name != "metadata.yaml")


def _written(contents: dict[str, bytes], kind: Kind, folder: Path, *, alone: bool) -> Read:
    if kind == "ros1" or alone:
        path = folder / f"bag{SUFFIXES[kind]}"
        path.write_bytes(contents[_data_file(contents)])
        return frames_of(path)
    path = folder / "bag"
    path.mkdir()
    for name, data in contents.items():
        (path / name).write_bytes(data)
    return frames_of(path)


def _split_mcap(data: bytes) -> tuple[bytes, list[bytes]]:
    records, at = [], MCAP_START
    while at + 9 <= len(data):
        end = at + 9 + int.from_bytes(data[at + 1 : at + 9], "little")
        records.append(data[at:end])
        at = end
    return data[:MCAP_START], [*records, data[at:]]


def _split_ros1(data: bytes) -> tuple[bytes, list[bytes]]:
    start = data.index(b"\n") + 1
    records, at = [], start
    while at + 8 <= len(data):
        middle = at + 4 + int.from_bytes(data[at : at + 4], "little")
        end = middle + 4 + int.from_bytes(data[middle : middle + 4], "little")
        records.append(data[at:end])
        at = end
    return data[:start], records


def _changed_records(rng: random.Random, records: list[bytes]) -> list[bytes]:
    records = list(records)
    for _ in range(rng.choice((1, 1, 2, 4))):
        at = rng.randrange(len(records))
        kind = rng.randrange(6)
        if kind == 0 and len(records) > 1:
            del records[at]
        elif kind == 1:
            records.insert(at, records[at])
        elif kind == 2:
            records.append(records.pop(at))
        else:
            # The first bytes hold the lengths, and the fields of a ROS 1 record's header.
            head = rng.choice((9, 40, 200))
            records[at] = mutations.bytes_of(rng, records[at][:head]) + records[at][head:]
    return records


def _changed_table(rng: random.Random, data: bytes) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.db3"
        path.write_bytes(data)
        connection = sqlite3.connect(path)
        tables = [row[0] for row in connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'")]
        table = rng.choice(tables)
        columns = [row[1] for row in connection.execute(f"PRAGMA table_info({table})")]
        column = rng.choice(columns)
        values = (None, -1, 2**62, "", "a\nb", "x" * 5000, b"\0", b"\xff" * 100, 0.5)
        try:
            kind = rng.randrange(4)
            if kind == 0:
                connection.execute(f"DELETE FROM {table}")
            elif kind == 1:
                connection.execute(f"DROP TABLE {table}")
            else:
                connection.execute(f"UPDATE {table} SET {column} = ? WHERE rowid % 2 = 0", (rng.choice(values),))
            connection.commit()
        except sqlite3.Error:
            connection.rollback()
        connection.close()
        return path.read_bytes()


BAG_DOORS: dict[str, Door] = {
    "bag-bytes": bag_bytes,
    "bag-records": bag_records,
    "bag-messages": bag_messages,
    "metadata-yaml": metadata_yaml,
}
