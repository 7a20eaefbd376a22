"""Recovery of truncated bags: ROS 1 bags and MCAP files are scanned from the start, without their index."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path

from objectflow.errors import ReaderError
from objectflow.readers.bag_records import MessageEntry, MessageLocation, TruncatedFileError, decompress
from objectflow.readers.mcap_scan import MCAP_MAGIC, scan_mcap
from objectflow.readers.ros1_scan import ROS1_MAGIC, scan_ros1


def scan(path: Path) -> list[MessageEntry]:
    """Every complete message, in file order.

    Raises:
        ReaderError: the file is neither a ROS 1 bag nor an MCAP file.
    """
    with path.open("rb") as file:
        head = file.read(len(ROS1_MAGIC))
        if head == ROS1_MAGIC:
            found: Iterator[MessageEntry] = scan_ros1(file)
        elif head[: len(MCAP_MAGIC)] == MCAP_MAGIC:
            file.seek(len(MCAP_MAGIC))
            found = scan_mcap(file)
        else:
            raise ReaderError(f"{path}: neither a ROS 1 bag nor an MCAP file")
        entries = []
        try:
            for entry in found:
                entries.append(entry)
        except (TruncatedFileError, OSError, ValueError, struct.error, RuntimeError, EOFError, UnicodeDecodeError):
            # The scan ends at the first record that is incomplete.
            return entries
        return entries


class Chunks:
    """Random access to the messages of a scanned bag; the last chunk is kept decompressed."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._last: tuple[tuple[int, int, str], bytes] | None = None

    def read(self, location: MessageLocation) -> bytes:
        """The bytes of one message."""
        with self.path.open("rb") as file:
            if location.chunk is None:
                file.seek(location.start)
                return file.read(location.size)
            if self._last is None or self._last[0] != location.chunk:
                start, size, compression = location.chunk
                file.seek(start)
                self._last = location.chunk, decompress(file.read(size), compression)
            return self._last[1][location.start : location.start + location.size]
