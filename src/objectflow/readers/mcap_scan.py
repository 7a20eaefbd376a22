"""Scan of an MCAP file without its index: each record is an opcode, a size and content."""

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

MCAP_MAGIC = b"\x89MCAP0\r\n"
_FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK = 0x02, 0x03, 0x04, 0x05, 0x06
"""Record opcodes."""
_RECORD_HEAD = struct.Struct("<BQ")
_MESSAGE_HEAD = struct.Struct("<HIQQ")


class McapScan:
    """Reads every record of an MCAP file once, in file order.

    Args:
        file: the whole file.
        chunks: decompresses the chunks.

    Attributes:
        complete: whether the footer was reached.
    """

    def __init__(self, file: Span, chunks: ChunkReader) -> None:
        self.complete = False
        self._file = file
        self._chunks = chunks
        self._schemas: dict[int, str] = {}
        self._channels: dict[int, Channel] = {}

    def entries(self) -> Iterator[MessageEntry]:
        """Yield the messages of use; a damaged chunk is left out.

        Raises:
            TruncatedFileError, struct.error, UnicodeDecodeError: the file is cut off, or a record is damaged.
        """
        position = len(MCAP_MAGIC)
        while position < self._file.size:
            opcode, size = _RECORD_HEAD.unpack(self._file.read(position, _RECORD_HEAD.size))
            start = position + _RECORD_HEAD.size
            if opcode == _FOOTER:
                self.complete = True
                return
            if opcode == _CHUNK:
                yield from self._chunk(start)
            else:
                yield from self._records(self._file, position, start + size, None)
            position = start + size

    def _chunk(self, position: int) -> Iterator[MessageEntry]:
        unpacked, _, length = struct.unpack("<QII", self._file.read(position + 16, 16))
        compression = self._file.read(position + 32, length).decode()
        start = position + 32 + length + 8
        (packed,) = struct.unpack("<Q", self._file.read(start - 8, 8))
        if compression == "":
            # The records of an uncompressed chunk are read in place.
            yield from self._records(self._file, start, start + packed, None)
            return
        place = ChunkPlace(start, packed, compression, unpacked)
        data = self._chunks.unpack(self._file, place)
        if data is not None:
            yield from self._records(data, 0, data.size, place)

    def _records(self, span: Span, position: int, end: int, chunk: ChunkPlace | None) -> Iterator[MessageEntry]:
        """The messages among the records from `position` to `end`; chunks within chunks are not read."""
        while position < end:
            opcode, size = _RECORD_HEAD.unpack(span.read(position, _RECORD_HEAD.size))
            position += _RECORD_HEAD.size
            if opcode == _MESSAGE:
                number, _, time, _ = _MESSAGE_HEAD.unpack(span.read(position, _MESSAGE_HEAD.size))
                channel = self._channels.get(number)
                if channel is not None:
                    start = position + _MESSAGE_HEAD.size
                    location = MessageLocation(chunk, start, size - _MESSAGE_HEAD.size)
                    entry = make_entry(channel, time, span, location)
                    if entry is not None:
                        yield entry
            elif opcode in (_SCHEMA, _CHANNEL):
                if size > MAX_RECORD_HEADER_BYTES:
                    raise TruncatedFileError
                self._define(opcode, span.read(position, size))
            position += size

    def _define(self, opcode: int, content: bytes) -> None:
        """Register a schema or a channel; those of other serialisations than ROS's are not registered."""
        if opcode == _SCHEMA:
            (number,) = struct.unpack_from("<H", content)
            self._schemas[number] = _text(content, 2)[0]
            return
        number, schema = struct.unpack_from("<HH", content)
        topic, position = _text(content, 4)
        encoding, _ = _text(content, position)
        if encoding in ("cdr", "ros1") and schema in self._schemas:
            self._channels[number] = Channel(topic, full_type(self._schemas[schema]), encoding == "cdr")


def _text(content: bytes, position: int) -> tuple[str, int]:
    """A string with its length before it, and the position after it."""
    (length,) = struct.unpack_from("<I", content, position)
    end = position + 4 + length
    if end > len(content):
        raise TruncatedFileError
    return content[position + 4 : end].decode(), end
