"""Scan of a ROS 1 bag, format 2.0, without its index: each record is a header of fields, then data."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from typing import BinaryIO

from objectflow.readers.bag_records import (
    Channel,
    MessageEntry,
    MessageLocation,
    TruncatedFileError,
    decompress,
    read_exactly,
)

ROS1_MAGIC = b"#ROSBAG V2.0\n"
_MESSAGE, _CHUNK, _CONNECTION = 2, 5, 7
"""Record opcodes."""


def scan_ros1(file: BinaryIO) -> Iterator[MessageEntry]:
    """Yield the messages of all complete chunks.

    Args:
        file: positioned after the magic bytes.

    Raises:
        TruncatedFileError: the file ends within a record.
    """
    channels: dict[int, Channel] = {}
    while True:
        begin = file.read(4)
        if not begin:
            return
        if len(begin) < 4:
            raise TruncatedFileError
        fields = _fields(read_exactly(file, struct.unpack("<I", begin)[0]))
        (size,) = struct.unpack("<I", read_exactly(file, 4))
        op = fields["op"][0]
        if op == _CHUNK:
            compression = fields["compression"].decode()
            start = file.tell()
            chunk = decompress(read_exactly(file, size), compression)
            yield from _scan_chunk(chunk, channels, (start, size, compression))
        elif op == _CONNECTION:
            _add_channel(fields, read_exactly(file, size), channels)
        else:
            read_exactly(file, size)


def _scan_chunk(chunk: bytes, channels: dict[int, Channel], where: tuple[int, int, str]) -> Iterator[MessageEntry]:
    position = 0
    while position < len(chunk):
        (length,) = struct.unpack_from("<I", chunk, position)
        fields = _fields(chunk[position + 4 : position + 4 + length])
        position += 4 + length
        (size,) = struct.unpack_from("<I", chunk, position)
        position += 4
        if fields["op"][0] == _CONNECTION:
            _add_channel(fields, chunk[position : position + size], channels)
        elif fields["op"][0] == _MESSAGE:
            (number,) = struct.unpack("<I", fields["conn"])
            seconds, nanoseconds = struct.unpack("<II", fields["time"])
            location = MessageLocation(where, position, size)
            yield MessageEntry(channels[number], seconds * 10**9 + nanoseconds, location)
        position += size


def _fields(header: bytes) -> dict[str, bytes]:
    fields, position = {}, 0
    while position < len(header):
        (size,) = struct.unpack_from("<I", header, position)
        name, equals, value = header[position + 4 : position + 4 + size].partition(b"=")
        if not equals:
            raise TruncatedFileError
        fields[name.decode()] = value
        position += 4 + size
    return fields


def _add_channel(fields: dict[str, bytes], data: bytes, channels: dict[int, Channel]) -> None:
    connection = _fields(data)
    (number,) = struct.unpack("<I", fields["conn"])
    package, _, name = connection["type"].decode().partition("/")
    definition = connection["message_definition"].decode()
    channels[number] = Channel(fields["topic"].decode(), f"{package}/msg/{name}", definition)
