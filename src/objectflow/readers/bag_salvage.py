"""What is whole in a bag that was cut off: ROS 1 bags and MCAP files, read from the start without their index."""

from __future__ import annotations

import bz2
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, NamedTuple

from objectflow.errors import ReaderError

MCAP_MAGIC = b"\x89MCAP0\r\n"
ROS1_MAGIC = b"#ROSBAG V2.0\n"


class Place(NamedTuple):
    """Where a message lies: its chunk in the file (None: not in a chunk), and its bytes there."""

    chunk: tuple[int, int, str] | None
    start: int
    size: int


class Channel(NamedTuple):
    """A topic's type and its definition's text."""

    topic: str
    msgtype: str
    definition: str


@dataclass(frozen=True)
class Entry:
    """One message of a bag."""

    channel: Channel
    time: int
    place: Place


def scan(path: Path) -> tuple[list[Entry], bool]:
    """Every message that is whole, in the file's order, and whether the file ends as it should.

    Raises:
        ReaderError: neither a ROS 1 bag nor an MCAP file.
    """
    with path.open("rb") as file:
        head = file.read(len(ROS1_MAGIC))
        if head == ROS1_MAGIC:
            walk: Iterator[Entry] = _scan_ros1(file)
        elif head[: len(MCAP_MAGIC)] == MCAP_MAGIC:
            file.seek(len(MCAP_MAGIC))
            walk = _scan_mcap(file)
        else:
            raise ReaderError(f"{path}: neither a ROS 1 bag nor an MCAP file")
        entries = []
        try:
            for entry in walk:
                entries.append(entry)
        except (_CutOffError, OSError, ValueError, struct.error, RuntimeError, EOFError, UnicodeDecodeError):
            return entries, False
        return entries, True


class Chunks:
    """Random access to the messages of a scanned bag; keeps the last chunk unpacked."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._last: tuple[tuple[int, int, str], bytes] | None = None

    def read(self, place: Place) -> bytes:
        """The bytes of one message."""
        with self.path.open("rb") as file:
            if place.chunk is None:
                file.seek(place.start)
                return file.read(place.size)
            if self._last is None or self._last[0] != place.chunk:
                start, size, compression = place.chunk
                file.seek(start)
                self._last = place.chunk, _unpack(file.read(size), compression)
            return self._last[1][place.start : place.start + place.size]


class _CutOffError(Exception):
    """The file ends within a record."""


def _exactly(file: BinaryIO, size: int) -> bytes:
    data = file.read(size)
    if len(data) != size:
        raise _CutOffError
    return data


def _scan_ros1(file: BinaryIO) -> Iterator[Entry]:
    """Records of a ROS 1 bag, format 2.0: a header of fields, then data; chunks hold records themselves."""
    channels: dict[int, Channel] = {}
    while True:
        begin = file.read(4)
        if not begin:
            return
        if len(begin) < 4:
            raise _CutOffError
        fields = _ros1_fields(_exactly(file, struct.unpack("<I", begin)[0]))
        (size,) = struct.unpack("<I", _exactly(file, 4))
        op = fields["op"][0]
        if op == 5:
            compression = fields["compression"].decode()
            start = file.tell()
            chunk = _unpack(_exactly(file, size), compression)
            yield from _ros1_chunk(chunk, channels, (start, size, compression))
        elif op == 7:
            _ros1_channel(fields, _exactly(file, size), channels)
        else:
            _exactly(file, size)


def _ros1_chunk(chunk: bytes, channels: dict[int, Channel], where: tuple[int, int, str]) -> Iterator[Entry]:
    position = 0
    while position < len(chunk):
        (length,) = struct.unpack_from("<I", chunk, position)
        fields = _ros1_fields(chunk[position + 4 : position + 4 + length])
        position += 4 + length
        (size,) = struct.unpack_from("<I", chunk, position)
        position += 4
        if fields["op"][0] == 7:
            _ros1_channel(fields, chunk[position : position + size], channels)
        elif fields["op"][0] == 2:
            (number,) = struct.unpack("<I", fields["conn"])
            seconds, nanoseconds = struct.unpack("<II", fields["time"])
            yield Entry(channels[number], seconds * 10**9 + nanoseconds, Place(where, position, size))
        position += size


def _ros1_fields(header: bytes) -> dict[str, bytes]:
    fields, position = {}, 0
    while position < len(header):
        (size,) = struct.unpack_from("<I", header, position)
        name, equals, value = header[position + 4 : position + 4 + size].partition(b"=")
        if not equals:
            raise _CutOffError
        fields[name.decode()] = value
        position += 4 + size
    return fields


def _ros1_channel(fields: dict[str, bytes], data: bytes, channels: dict[int, Channel]) -> None:
    about = _ros1_fields(data)
    (number,) = struct.unpack("<I", fields["conn"])
    package, _, name = about["type"].decode().partition("/")
    channels[number] = Channel(fields["topic"].decode(), f"{package}/msg/{name}", about["message_definition"].decode())


def _scan_mcap(file: BinaryIO) -> Iterator[Entry]:
    """Records of an MCAP file: an opcode, a size, content; chunks hold records themselves."""
    schemas: dict[int, tuple[str, str]] = {}
    channels: dict[int, Channel] = {}
    while True:
        opcode = file.read(1)
        if not opcode:
            raise _CutOffError
        (size,) = struct.unpack("<Q", _exactly(file, 8))
        start = file.tell()
        if opcode[0] == 0x02:
            return
        if opcode[0] == 0x06:
            content = _exactly(file, size)
            (length,) = struct.unpack_from("<I", content, 28)
            compression = content[32 : 32 + length].decode()
            (packed,) = struct.unpack_from("<Q", content, 32 + length)
            begin = 40 + length
            chunk = _unpack(content[begin : begin + packed], compression)
            yield from _mcap_records(chunk, 0, schemas, channels, (start + begin, packed, compression))
        elif opcode[0] in (0x03, 0x04, 0x05):
            content = opcode + struct.pack("<Q", size) + _exactly(file, size)
            yield from _mcap_records(content, start - 9, schemas, channels, None)
        else:
            _exactly(file, size)


def _mcap_records(
    data: bytes,
    offset: int,
    schemas: dict[int, tuple[str, str]],
    channels: dict[int, Channel],
    where: tuple[int, int, str] | None,
) -> Iterator[Entry]:
    position = 0
    while position < len(data):
        opcode = data[position]
        (size,) = struct.unpack_from("<Q", data, position + 1)
        position += 9
        content = data[position : position + size]
        if opcode == 0x03:
            (number,) = struct.unpack_from("<H", content)
            name, _, rest = _mcap_texts(content[2:])
            schemas[number] = name, rest.decode()
        elif opcode == 0x04:
            number, schema = struct.unpack_from("<HH", content)
            (length,) = struct.unpack_from("<I", content, 4)
            topic = content[8 : 8 + length].decode()
            channels[number] = Channel(topic, *schemas[schema])
        elif opcode == 0x05:
            number, _, time, _ = struct.unpack_from("<HIQQ", content)
            yield Entry(channels[number], time, Place(where, offset + position + 22, size - 22))
        position += size


def _mcap_texts(content: bytes) -> tuple[str, str, bytes]:
    """Name, encoding and text of a schema record."""
    (length,) = struct.unpack_from("<I", content)
    name = content[4 : 4 + length].decode()
    content = content[4 + length :]
    (length,) = struct.unpack_from("<I", content)
    encoding = content[4 : 4 + length].decode()
    content = content[4 + length :]
    (length,) = struct.unpack_from("<I", content)
    return name, encoding, content[4 : 4 + length]


def _unpack(data: bytes, compression: str) -> bytes:
    unpackers: dict[str, Callable[[bytes], bytes]] = {"": bytes, "none": bytes, "bz2": bz2.decompress}
    if compression == "lz4":
        import lz4.frame  # type: ignore[import-untyped]

        unpackers["lz4"] = lz4.frame.decompress
    if compression == "zstd":
        from backports import zstd

        unpackers["zstd"] = zstd.decompress
    if compression not in unpackers:
        raise ValueError(f"compression {compression!r} is not known")
    return unpackers[compression](data)
