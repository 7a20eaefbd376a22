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
    images = [number for number, channel in channels.items() if channel.msgtype in IMAGE_TYPES]
    small = [number for number, channel in channels.items() if channel.msgtype in SMALL_TYPES]
    # Only the pages of an image that hold its stamp are read.
    head = (
        f"CASE WHEN topic_id NOT IN ({_list(images)}) THEN substr(data, 1, {MAX_SMALL_BYTES + 1}) "
        f"WHEN substr(data, 1, 4) = X'{ZSTD_MAGIC.hex()}' THEN substr(data, 1, {HEAD_BYTES}) "
        f"ELSE substr(data, 1, {STAMP_BYTES}) END"
    )
    chosen = f"WHERE topic_id IN ({_list(images + small)}) ORDER BY id"
    query = f"SELECT id, topic_id, timestamp, {head} FROM messages {chosen}"
    for row, number, time, content in connection.execute(query):
        channel = channels[int(number)]
        location = MessageLocation(None, int(row), 0)
        data = bytes(content)
        if channel.msgtype in IMAGE_TYPES:
            start = unpack_head(data, STAMP_BYTES) if data.startswith(ZSTD_MAGIC) else data
            yield MessageEntry(channel, int(time), header_stamp(start, is_cdr=True), location)
        elif len(data) <= MAX_SMALL_BYTES:
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


def _list(numbers: list[int]) -> str:
    return ", ".join(str(number) for number in numbers) or "NULL"
