"""The messages of a ROS 1 bag, a ROS 2 bag or an MCAP file by topic and number; no ROS installation is needed."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any, Protocol

from objectflow.errors import MissingExtraError, ReaderError
from objectflow.readers.bag_records import MessageEntry
from objectflow.readers.bag_recovery import Chunks, scan

try:
    from rosbags.highlevel import AnyReader, AnyReaderError
    from rosbags.interfaces import Connection
    from rosbags.typesys import Stores, TypesysError, get_types_from_msg, get_typestore
except ImportError as error:
    raise MissingExtraError("bags need rosbags", "bag") from error


class BagMessages(Protocol):
    """Random access to a bag.

    Attributes:
        types: topic -> message type, such as `sensor_msgs/msg/Image`.
        cut_off: whether the bag is truncated and only its complete part can be read.
    """

    types: dict[str, str]
    cut_off: bool

    def stamps(self, topic: str) -> list[int]:
        """Header stamp of each message in bag order, nanoseconds; the recording time where the stamp is 0."""
        ...

    def read(self, topic: str, number: int) -> Any:
        """Deserialise one message.

        Raises:
            ReaderError: the message is broken.
        """
        ...


def open_messages(path: Path) -> BagMessages:
    """Open a bag; a truncated bag is read as far as it is complete.

    Raises:
        ReaderError: the path is not a bag, or no message in it is complete.
    """
    try:
        return _IndexedBag(path)
    except (AnyReaderError, TypesysError, OSError, ValueError, struct.error, KeyError, AssertionError) as error:
        file = _single_file(path)
        if file is None:
            raise ReaderError(f"{path}: not a bag that can be read: {error}") from error
        try:
            return _TruncatedBag(file)
        except ReaderError:
            raise ReaderError(f"{path}: not a bag that can be read: {error}") from error


def _single_file(path: Path) -> Path | None:
    if path.is_file():
        return path
    inside = sorted(path.glob("*.mcap"))
    return inside[0] if len(inside) == 1 else None


class _IndexedBag:
    """A complete bag with its index, read through rosbags."""

    cut_off = False

    def __init__(self, path: Path) -> None:
        self._path = path
        self._reader = AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE))
        self._reader.open()
        self.types = {c.topic: c.msgtype for c in self._reader.connections if c.msgtype.startswith("sensor_msgs/")}
        self._connections: dict[str, list[Connection]] = {
            topic: [c for c in self._reader.connections if c.topic == topic] for topic in self.types
        }
        self._times: dict[str, list[int]] = {}

    def stamps(self, topic: str) -> list[int]:
        times, stamps = [], []
        for _, time, data in self._reader.messages(self._connections[topic]):
            times.append(time)
            stamps.append(header_stamp(data, ros2=self._reader.is2) or time)
        self._times[topic] = times
        return stamps

    def read(self, topic: str, number: int) -> Any:
        if topic not in self._times:
            self.stamps(topic)
        time = self._times[topic][number]
        # Several messages of a topic may share a recording time.
        skip = sum(earlier == time for earlier in self._times[topic][:number])
        try:
            for connection, _, data in self._reader.messages(self._connections[topic], time, time + 1):
                if skip == 0:
                    return self._reader.deserialize(data, connection.msgtype)
                skip -= 1
        except (AnyReaderError, OSError, ValueError, struct.error) as error:
            raise ReaderError(f"{self._path}: message {number} of {topic} is broken: {error}") from error
        raise ReaderError(f"{self._path}: message {number} of {topic} cannot be found again")


class _TruncatedBag:
    """A bag that lost its index: its messages are found by a scan from the start."""

    cut_off = True

    def __init__(self, path: Path) -> None:
        self._path = path
        entries = scan(path)
        self._entries: dict[str, list[MessageEntry]] = {}
        for entry in entries:
            if entry.channel.msgtype.startswith("sensor_msgs/"):
                self._entries.setdefault(entry.channel.topic, []).append(entry)
        if not self._entries:
            raise ReaderError(f"{path}: cut off, and it holds no complete image")
        self.types = {topic: found[0].channel.msgtype for topic, found in self._entries.items()}
        self._ros2 = path.suffix != ".bag"
        self._store = get_typestore(Stores.EMPTY)
        types: dict[str, Any] = {}
        for found in self._entries.values():
            types.update(get_types_from_msg(found[0].channel.definition, found[0].channel.msgtype))
        self._store.register(types)
        self._chunks = Chunks(path)

    def stamps(self, topic: str) -> list[int]:
        read = self._chunks.read
        return [header_stamp(read(entry.location), ros2=self._ros2) or entry.time for entry in self._entries[topic]]

    def read(self, topic: str, number: int) -> Any:
        entry = self._entries[topic][number]
        data = self._chunks.read(entry.location)
        deserialize = self._store.deserialize_cdr if self._ros2 else self._store.deserialize_ros1
        return deserialize(data, entry.channel.msgtype)


def header_stamp(data: bytes | memoryview, *, ros2: bool) -> int:
    """Stamp of a serialised message that starts with a `std_msgs/Header`, nanoseconds; 0 if it is too short."""
    if len(data) < 12:
        return 0
    if ros2:
        # The stamp follows four bytes of CDR encapsulation, the second of which holds the byte order.
        seconds, nanoseconds = struct.unpack_from("<iI" if data[1] == 1 else ">iI", data, 4)
    else:
        # The stamp follows the sequence number.
        seconds, nanoseconds = struct.unpack_from("<II", data, 4)
    return int(seconds) * 10**9 + int(nanoseconds)
