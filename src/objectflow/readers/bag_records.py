"""What the scans of ROS 1 bags, MCAP files and SQLite bags share: entries, bounded reads and bounded decompression."""

from __future__ import annotations

import bz2
import struct
from dataclasses import dataclass
from typing import Any, BinaryIO, NamedTuple, Protocol

from objectflow.readers.message_compression import HEAD_BYTES, ZSTD_MAGIC, unpack_head, unpack_message

IMAGE_TYPES = frozenset({"sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"})
"""Message types of which only the position is kept."""
INFO_TYPE = "sensor_msgs/msg/CameraInfo"
TRANSFORM_TYPES = frozenset({"tf2_msgs/msg/TFMessage", "tf/msg/tfMessage"})
EXTRINSICS_TYPES = frozenset({"realsense2_camera_msgs/msg/Extrinsics", "realsense2_camera/msg/Extrinsics"})
"""Type of the RealSense driver's topics such as `extrinsics/depth_to_color`."""
SMALL_TYPES = frozenset({INFO_TYPE}) | TRANSFORM_TYPES | EXTRINSICS_TYPES
"""Message types whose content is kept by the scan."""
MAX_SMALL_BYTES = 1 << 16
"""Largest content of a small message, bytes; larger ones are ignored."""
MAX_SMALL_MESSAGES = 2000
"""Largest number of transform messages kept per topic; the transforms within a camera are in the first ones."""
MAX_RECORD_HEADER_BYTES = 1 << 24
"""Largest header of a record, bytes; a larger one is damaged."""
MAX_CHUNK_BYTES = 1 << 30
"""Largest chunk that is decompressed, bytes."""
STAMP_BYTES = 12
"""Number of bytes of a serialised message up to the end of its stamp: 4 bytes of CDR encapsulation or ROS 1 sequence
number, then seconds and nanoseconds."""


class ChunkPlace(NamedTuple):
    """Position of a compressed chunk in its file; `unpacked` is its stated size after decompression, in bytes."""

    start: int
    size: int
    compression: str
    unpacked: int


class MessageLocation(NamedTuple):
    """Position of a message: in its chunk, in the file (`chunk` is None), or the row of a database (`size` is 0)."""

    chunk: ChunkPlace | None
    start: int
    size: int


class Channel(NamedTuple):
    """A topic with its message type; `is_cdr` tells the serialisation of ROS 2 from that of ROS 1."""

    topic: str
    msgtype: str
    is_cdr: bool


@dataclass(frozen=True)
class MessageEntry:
    """One message of a bag.

    Attributes:
        channel: its topic.
        time: of recording, nanoseconds.
        stamp: of its header, nanoseconds; 0 if it has none.
        location: where its content is.
        content: the serialised message, if its type is small.
    """

    channel: Channel
    time: int
    stamp: int
    location: MessageLocation
    content: bytes | None = None


class TruncatedFileError(Exception):
    """The file ends within a record, or the lengths of a record are damaged."""


class Span(Protocol):
    """A range of bytes with random access: a file, or a decompressed chunk in memory."""

    size: int

    def read(self, start: int, size: int) -> bytes:
        """Read exactly `size` bytes.

        Raises:
            TruncatedFileError: the span ends earlier.
        """
        ...


class FileSpan:
    """A file that is open for reading."""

    def __init__(self, file: BinaryIO, size: int) -> None:
        self._file = file
        self.size = size

    def read(self, start: int, size: int) -> bytes:
        """Read exactly `size` bytes; the errors are those of `Span.read`."""
        if size < 0 or start + size > self.size:
            raise TruncatedFileError
        self._file.seek(start)
        data = self._file.read(size)
        if len(data) != size:
            raise TruncatedFileError
        return data


class MemorySpan:
    """Bytes in memory."""

    def __init__(self, data: bytes) -> None:
        self._data = data
        self.size = len(data)

    def read(self, start: int, size: int) -> bytes:
        """Read exactly `size` bytes; the errors are those of `Span.read`."""
        if size < 0 or start + size > self.size:
            raise TruncatedFileError
        return self._data[start : start + size]


def full_type(name: str) -> str:
    """A message type with its folder, as in ROS 2: `sensor_msgs/Image` becomes `sensor_msgs/msg/Image`."""
    package, _, kind = name.partition("/")
    return name if kind.startswith("msg/") else f"{package}/msg/{kind}"


def make_entry(channel: Channel, time: int, span: Span, location: MessageLocation) -> MessageEntry | None:
    """The entry of a message, or None if its type is of no use here.

    Args:
        channel: its topic.
        time: of recording, nanoseconds.
        span: the file, or the chunk of the message.
        location: of the message in `span`.

    Raises:
        TruncatedFileError: the span ends within the message.
    """
    if channel.msgtype in IMAGE_TYPES:
        if location.start + location.size > span.size:
            raise TruncatedFileError
        head = span.read(location.start, min(STAMP_BYTES, location.size))
        if head.startswith(ZSTD_MAGIC):
            head = unpack_head(span.read(location.start, min(HEAD_BYTES, location.size)), STAMP_BYTES)
        return MessageEntry(channel, time, header_stamp(head, is_cdr=channel.is_cdr), location)
    if channel.msgtype in SMALL_TYPES and location.size <= MAX_SMALL_BYTES:
        content = unpack_message(span.read(location.start, location.size))
        return MessageEntry(channel, time, header_stamp(content, is_cdr=channel.is_cdr), location, content)
    return None


def header_stamp(data: bytes | memoryview, *, is_cdr: bool) -> int:
    """Stamp of a serialised message that starts with a `std_msgs/Header`, nanoseconds; 0 if it is too short."""
    if len(data) < STAMP_BYTES:
        return 0
    # The second byte of the CDR encapsulation holds the byte order.
    form = "<II" if not is_cdr else "<iI" if data[1] & 1 else ">iI"
    seconds, nanoseconds = struct.unpack_from(form, data, 4)
    return int(seconds) * 10**9 + int(nanoseconds)


def decompress(data: bytes, compression: str, unpacked: int) -> bytes:
    """Decompress a chunk or a message.

    Args:
        data: the compressed bytes.
        compression: "bz2", "lz4" or "zstd".
        unpacked: stated size of the result in bytes; decompression ends there.

    Raises:
        ValueError: unknown compression, or the result has another size than stated.
    """
    if not 0 <= unpacked <= MAX_CHUNK_BYTES:
        raise ValueError(f"a chunk of {unpacked} bytes is too large")
    decompressor: Any
    if compression == "bz2":
        decompressor = bz2.BZ2Decompressor()
    elif compression == "lz4":
        import lz4.frame  # type: ignore[import-untyped]

        decompressor = lz4.frame.LZ4FrameDecompressor()
    elif compression == "zstd":
        from backports import zstd

        decompressor = zstd.ZstdDecompressor()
    else:
        raise ValueError(f"compression {compression!r} is not known")
    # A decompressor may return less than it could, so it is called until it returns nothing.
    parts, length, rest = [], 0, data
    while length < unpacked and not decompressor.eof:
        part = decompressor.decompress(rest, unpacked - length)
        if not part:
            break
        parts.append(part)
        length += len(part)
        rest = b""
    if length != unpacked:
        raise ValueError(f"a chunk ends after {length} of {unpacked} bytes")
    return b"".join(parts)
