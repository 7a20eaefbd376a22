"""Scan of a ROS 2 bag in SQLite (`.db3`): messages are rows, of which only the first bytes are read."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from pathlib import Path

from objectflow.readers.bag_records import (
    IMAGE_TYPES,
    MAX_SMALL_BYTES,
    SMALL_TYPES,
    STAMP_BYTES,
    Channel,
    MessageEntry,
    MessageLocation,
    full_type,
    header_stamp,
)
from objectflow.readers.message_compression import HEAD_BYTES, ZSTD_MAGIC, unpack_head, unpack_message

SQLITE_MAGIC = b"SQLite format 3\x00"


def connect(path: Path) -> sqlite3.Connection:
    """Open a database for reading, without leaving files beside it.

    Raises:
        sqlite3.Error: it cannot be opened.
    """
    log = path.with_name(f"{path.name}-wal")
    # Without a write-ahead log to read, SQLite need not create a new one.
    mode = "mode=ro" if log.is_file() and log.stat().st_size > 0 else "mode=ro&immutable=1"
    return sqlite3.connect(f"{path.resolve().as_uri()}?{mode}", uri=True, check_same_thread=False)


def scan_rows(connection: sqlite3.Connection) -> Iterator[MessageEntry]:
    """Yield the messages of use in the order of recording.

    Raises:
        sqlite3.Error: the database is damaged from here on.
    """
    channels: dict[int, Channel] = {}
    for number, topic, msgtype, encoding in connection.execute(
        "SELECT id, name, type, serialization_format FROM topics"
    ):
        if encoding in (None, "", "cdr"):
            channels[int(number)] = Channel(str(topic), full_type(str(msgtype)), is_cdr=True)
    wanted = [number for number, channel in channels.items() if channel.msgtype in IMAGE_TYPES | SMALL_TYPES]
    query = f"SELECT id, topic_id, timestamp FROM messages WHERE topic_id IN ({_list(wanted)}) ORDER BY id"
    for row, number, time in connection.execute(query):
        channel = channels[int(number)]
        location = MessageLocation(None, int(row), 0)
        if channel.msgtype in IMAGE_TYPES:
            head = _read_start(connection, int(row), STAMP_BYTES)
            if head.startswith(ZSTD_MAGIC):
                head = unpack_head(_read_start(connection, int(row), HEAD_BYTES), STAMP_BYTES)
            yield MessageEntry(channel, int(time), header_stamp(head, is_cdr=True), location)
            continue
        data = _read_start(connection, int(row), MAX_SMALL_BYTES + 1)
        if len(data) <= MAX_SMALL_BYTES:
            message = unpack_message(data)
            yield MessageEntry(channel, int(time), header_stamp(message, is_cdr=True), location, message)


def read_row(connection: sqlite3.Connection, location: MessageLocation) -> bytes:
    """The content of a message.

    Raises:
        sqlite3.Error: the database is damaged.
        LookupError: there is no such row.
    """
    found = connection.execute("SELECT data FROM messages WHERE id = ?", (location.start,)).fetchone()
    if found is None:
        raise LookupError("the row has disappeared")
    return unpack_message(bytes(found[0]))


def _read_start(connection: sqlite3.Connection, row: int, size: int) -> bytes:
    """The first `size` bytes of a message, or all of a shorter one."""
    if hasattr(connection, "blobopen"):  # since Python 3.11
        # Only the pages with these bytes are read; a query reads all pages of the message.
        with connection.blobopen("messages", "data", row, readonly=True) as blob:
            return blob.read(size)
    found = connection.execute("SELECT substr(data, 1, ?) FROM messages WHERE id = ?", (size, row)).fetchone()
    return bytes(found[0])


def _list(numbers: list[int]) -> str:
    return ", ".join(str(number) for number in numbers) or "NULL"
