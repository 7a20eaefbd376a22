"""Scan of an MCAP file without its index: each record is an opcode, a size and content."""

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

MCAP_MAGIC = b"\x89MCAP0\r\n"
_FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK = 0x02, 0x03, 0x04, 0x05, 0x06
"""Record opcodes."""


def scan_mcap(file: BinaryIO) -> Iterator[MessageEntry]:
    """Yield the messages of all complete records and chunks.

    Args:
        file: positioned after the magic bytes.

    Raises:
        TruncatedFileError: the file ends without its footer.
    """
    schemas: dict[int, tuple[str, str]] = {}
    channels: dict[int, Channel] = {}
    while True:
        opcode = file.read(1)
        if not opcode:
            raise TruncatedFileError
        (size,) = struct.unpack("<Q", read_exactly(file, 8))
        start = file.tell()
        if opcode[0] == _FOOTER:
            return
        if opcode[0] == _CHUNK:
            content = read_exactly(file, size)
            (length,) = struct.unpack_from("<I", content, 28)
            compression = content[32 : 32 + length].decode()
            (packed,) = struct.unpack_from("<Q", content, 32 + length)
            begin = 40 + length
            chunk = decompress(content[begin : begin + packed], compression)
            yield from _scan_records(chunk, 0, schemas, channels, (start + begin, packed, compression))
        elif opcode[0] in (_SCHEMA, _CHANNEL, _MESSAGE):
            content = opcode + struct.pack("<Q", size) + read_exactly(file, size)
            yield from _scan_records(content, start - 9, schemas, channels, None)
        else:
            read_exactly(file, size)


def _scan_records(
    data: bytes,
    offset: int,
    schemas: dict[int, tuple[str, str]],
    channels: dict[int, Channel],
    where: tuple[int, int, str] | None,
) -> Iterator[MessageEntry]:
    position = 0
    while position < len(data):
        opcode = data[position]
        (size,) = struct.unpack_from("<Q", data, position + 1)
        position += 9
        content = data[position : position + size]
        if opcode == _SCHEMA:
            (number,) = struct.unpack_from("<H", content)
            name, _, definition = _schema_fields(content[2:])
            schemas[number] = name, definition.decode()
        elif opcode == _CHANNEL:
            number, schema = struct.unpack_from("<HH", content)
            (length,) = struct.unpack_from("<I", content, 4)
            topic = content[8 : 8 + length].decode()
            channels[number] = Channel(topic, *schemas[schema])
        elif opcode == _MESSAGE:
            number, _, time, _ = struct.unpack_from("<HIQQ", content)
            location = MessageLocation(where, offset + position + 22, size - 22)
            yield MessageEntry(channels[number], time, location)
        position += size


def _schema_fields(content: bytes) -> tuple[str, str, bytes]:
    """Name, encoding and definition of a schema record."""
    (length,) = struct.unpack_from("<I", content)
    name = content[4 : 4 + length].decode()
    content = content[4 + length :]
    (length,) = struct.unpack_from("<I", content)
    encoding = content[4 : 4 + length].decode()
    content = content[4 + length :]
    (length,) = struct.unpack_from("<I", content)
    return name, encoding, content[4 : 4 + length]
