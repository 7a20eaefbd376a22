"""What the scans of ROS 1 bags and MCAP files share: message locations, exact reads and decompression."""

from __future__ import annotations

import bz2
from collections.abc import Callable
from dataclasses import dataclass
from typing import BinaryIO, NamedTuple


class MessageLocation(NamedTuple):
    """Position of a message: its chunk in the file (None if it is in no chunk), and its byte range there."""

    chunk: tuple[int, int, str] | None
    start: int
    size: int


class Channel(NamedTuple):
    """A topic with its message type and the text of the type's definition."""

    topic: str
    msgtype: str
    definition: str


@dataclass(frozen=True)
class MessageEntry:
    """One message of a bag; `time` is the recording time in nanoseconds."""

    channel: Channel
    time: int
    location: MessageLocation


class TruncatedFileError(Exception):
    """The file ends within a record."""


def read_exactly(file: BinaryIO, size: int) -> bytes:
    """Read `size` bytes.

    Raises:
        TruncatedFileError: the file ends earlier.
    """
    data = file.read(size)
    if len(data) != size:
        raise TruncatedFileError
    return data


def decompress(data: bytes, compression: str) -> bytes:
    """Decompress a chunk.

    Raises:
        ValueError: unknown compression.
    """
    decompressors: dict[str, Callable[[bytes], bytes]] = {"": bytes, "none": bytes, "bz2": bz2.decompress}
    if compression == "lz4":
        import lz4.frame  # type: ignore[import-untyped]

        decompressors["lz4"] = lz4.frame.decompress
    if compression == "zstd":
        from backports import zstd

        decompressors["zstd"] = zstd.decompress
    if compression not in decompressors:
        raise ValueError(f"compression {compression!r} is not known")
    return decompressors[compression](data)
