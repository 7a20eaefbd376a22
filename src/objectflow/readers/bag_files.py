"""One file of a bag: a ROS 1 bag, an MCAP file or an SQLite database, read once without its index.

A file that is cut off, such as the `.bag.active` of a recorder that was killed, is read as far as it is complete.
"""

from __future__ import annotations

import sqlite3
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Protocol

from objectflow.errors import ReaderError
from objectflow.readers.bag_records import (
    MAX_SMALL_MESSAGES,
    STAMP_BYTES,
    TRANSFORM_TYPES,
    Channel,
    FileSpan,
    MessageEntry,
    MessageLocation,
    Span,
    TruncatedFileError,
)
from objectflow.readers.chunk_reader import ChunkReader
from objectflow.readers.mcap_scan import MCAP_MAGIC, McapScan
from objectflow.readers.message_compression import unpack_message
from objectflow.readers.ros1_scan import ROS1_MAGIC, Ros1Scan
from objectflow.readers.sqlite_scan import SQLITE_MAGIC, connect, read_row, scan_rows
from objectflow.storage.foreign import foreign_errors


class BagFile(Protocol):
    """One file of a bag.

    Attributes:
        entries: its messages of use in file order.
        cut_off: whether it ends in the middle.
        damaged: number of parts that could not be decompressed.
    """

    entries: list[MessageEntry]
    cut_off: bool
    damaged: int

    def read(self, location: MessageLocation) -> bytes:
        """The serialised content of a message; errors are those of the file system and of the decompressors."""
        ...


def open_bag_file(path: Path) -> BagFile:
    """Open a file of a bag; its kind is found by its first bytes.

    Raises:
        ReaderError: the file cannot be read, or is not a bag.
    """
    with foreign_errors(ReaderError, f"{path}: cannot be read"), path.open("rb") as file:
        start = file.read(len(SQLITE_MAGIC))
    if start.startswith((ROS1_MAGIC, MCAP_MAGIC)):
        with foreign_errors(ReaderError, f"{path}: not a bag that can be read"):
            return _RecordFile(path, is_mcap=start.startswith(MCAP_MAGIC))
    if start.startswith(SQLITE_MAGIC):
        with foreign_errors(ReaderError, f"{path}: not a bag that can be read"):
            return _Database(path)
    found = "an empty file" if not start else "neither a ROS 1 bag nor an MCAP file nor a SQLite bag"
    raise ReaderError(f"{path}: not a bag that can be read: {found}")


class _RecordFile:
    """A ROS 1 bag or an MCAP file."""

    def __init__(self, path: Path, *, is_mcap: bool) -> None:
        self._path = path
        self._chunks = ChunkReader()
        with path.open("rb") as file:
            span = FileSpan(file, path.stat().st_size)
            scan = McapScan(span, self._chunks) if is_mcap else Ros1Scan(span, self._chunks)
            self.entries = _collect(scan.entries())
        self.cut_off = not scan.complete
        self.damaged = self._chunks.damaged

    def read(self, location: MessageLocation) -> bytes:
        with self._path.open("rb") as file:
            span: Span = FileSpan(file, self._path.stat().st_size)
            if location.chunk is not None:
                span = self._chunks.read(span, location.chunk)
            return unpack_message(span.read(location.start, location.size))


class _Database:
    """A ROS 2 bag in SQLite."""

    damaged = 0

    def __init__(self, path: Path) -> None:
        self._connection = connect(path)
        self.cut_off = False
        self.entries = []
        try:
            for entry in scan_rows(self._connection):
                self.entries.append(entry)
        except sqlite3.Error:
            if not self.entries:
                raise
            self.cut_off = True

    def read(self, location: MessageLocation) -> bytes:
        return read_row(self._connection, location)


def _collect(found: Iterator[MessageEntry]) -> list[MessageEntry]:
    """All messages of a scan up to the first damaged record, without repeated content.

    Only the first ones of the transforms, and of equal camera infos in a row, are kept.
    """
    entries: list[MessageEntry] = []
    counts: dict[Channel, int] = {}
    last: dict[Channel, bytes] = {}
    try:
        for entry in found:
            if entry.content is not None:
                counts[entry.channel] = counts.get(entry.channel, 0) + 1
                is_transform = entry.channel.msgtype in TRANSFORM_TYPES
                if is_transform and counts[entry.channel] > MAX_SMALL_MESSAGES:
                    continue
                body = entry.content if is_transform else entry.content[STAMP_BYTES:]
                if last.get(entry.channel) == body:
                    continue
                last[entry.channel] = body
            entries.append(entry)
    except (TruncatedFileError, OSError, ValueError, KeyError, struct.error):
        # The scan ends at the first record that is incomplete.
        return entries
    return entries
