"""Scan of a ROS 1 bag, format 2.0, without its index: each record is a header of fields, then data."""

from __future__ import annotations

import struct
from collections.abc import Iterator

from objectflow.readers.bag_records import (
    MAX_RECORD_HEADER_BYTES,
    Channel,
    ChunkPlace,
    MessageEntry,
    MessageLocation,
    Span,
    TruncatedFileError,
    full_type,
    make_entry,
)
from objectflow.readers.chunk_reader import ChunkReader

ROS1_MAGIC = b"#ROSBAG V2.0\n"
_MESSAGE, _BAG_HEADER, _CHUNK, _CONNECTION = 2, 3, 5, 7
"""Record opcodes."""


class Ros1Scan:
    """Reads every record of a ROS 1 bag once, in file order.

    Args:
        file: the whole file.
        chunks: decompresses the chunks.

    Attributes:
        complete: whether the bag was closed by its recorder, and all its records were read.
    """

    def __init__(self, file: Span, chunks: ChunkReader) -> None:
        self.complete = False
        self._file = file
        self._chunks = chunks
        self._channels: dict[int, Channel] = {}

    def entries(self) -> Iterator[MessageEntry]:
        """Yield the messages of use; a damaged chunk is left out.

        Raises:
            TruncatedFileError, struct.error, KeyError, UnicodeDecodeError: the file is cut off or damaged.
        """
        position = len(ROS1_MAGIC)
        closed = False
        while position < self._file.size:
            fields, start, size = _read_head(self._file, position)
            opcode = _opcode(fields)
            if opcode == _BAG_HEADER:
                # The position of the index is 0 until the bag is closed.
                (index,) = struct.unpack("<Q", fields["index_pos"])
                closed = index > 0
            elif opcode == _CHUNK:
                (unpacked,) = struct.unpack("<I", fields["size"])
                compression = fields["compression"].decode()
                if compression == "none":
                    # The records of an uncompressed chunk are read in place.
                    yield from self._records(self._file, start, start + size, None)
                else:
                    place = ChunkPlace(start, size, compression, unpacked)
                    data = self._chunks.unpack(self._file, place)
                    if data is not None:
                        yield from self._records(data, 0, data.size, place)
            elif opcode == _CONNECTION:
                self._connect(fields, self._file.read(start, size))
            position = start + size
        self.complete = closed and position == self._file.size

    def _records(self, span: Span, position: int, end: int, chunk: ChunkPlace | None) -> Iterator[MessageEntry]:
        while position < end:
            fields, start, size = _read_head(span, position)
            opcode = _opcode(fields)
            if opcode == _CONNECTION:
                self._connect(fields, span.read(start, size))
            elif opcode == _MESSAGE:
                (number,) = struct.unpack("<I", fields["conn"])
                seconds, nanoseconds = struct.unpack("<II", fields["time"])
                location = MessageLocation(chunk, start, size)
                entry = make_entry(self._channels[number], seconds * 10**9 + nanoseconds, span, location)
                if entry is not None:
                    yield entry
            position = start + size

    def _connect(self, fields: dict[str, bytes], data: bytes) -> None:
        (number,) = struct.unpack("<I", fields["conn"])
        msgtype = full_type(_fields(data)["type"].decode())
        self._channels[number] = Channel(fields["topic"].decode(), msgtype, is_cdr=False)


def _read_head(span: Span, position: int) -> tuple[dict[str, bytes], int, int]:
    """The header fields of a record, and the start and the size of its data."""
    (length,) = struct.unpack("<I", span.read(position, 4))
    if length > MAX_RECORD_HEADER_BYTES:
        raise TruncatedFileError
    head = span.read(position + 4, length + 4)
    (size,) = struct.unpack_from("<I", head, length)
    return _fields(head[:length]), position + 8 + length, size


def _opcode(fields: dict[str, bytes]) -> int:
    return int.from_bytes(fields["op"][:1], "little")


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
