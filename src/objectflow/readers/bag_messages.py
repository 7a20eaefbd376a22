"""The messages of a bag by topic and number, from one or several files; no ROS installation is needed."""

from __future__ import annotations

import heapq
from pathlib import Path
from typing import Any

from objectflow.errors import MissingExtraError, ReaderError
from objectflow.readers.bag_files import BagFile, open_bag_file
from objectflow.readers.bag_paths import find_files
from objectflow.readers.bag_records import EXTRINSICS_TYPES, TRANSFORM_TYPES, MessageEntry
from objectflow.storage.foreign import foreign_errors

try:
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore
except ImportError as error:
    raise MissingExtraError("bags need rosbags", "bag") from error

_EXTRINSICS = "std_msgs/Header header\nfloat64[9] rotation\nfloat64[3] translation"
"""Definition of the RealSense driver's message."""
_TRANSFORMS = "geometry_msgs/TransformStamped[] transforms"
"""Definition of the message of tf and tf2."""


class BagMessages:
    """Random access to the messages of a bag.

    Args:
        path: a ROS 1 bag, an MCAP file, an SQLite bag, or a folder with the files of one bag.

    Attributes:
        types: topic -> message type, such as `sensor_msgs/msg/Image`, of the topics that have messages.
        cut_off: whether a file ends in the middle.
        notes: files that are cut off, damaged or missing, one sentence each.

    Raises:
        ReaderError: the path is not a bag, or holds no message of use.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._paths = find_files(path)
        self._files: list[BagFile] = []
        notes = list(self._paths.notes)
        failed: ReaderError | None = None
        for file in self._paths.files:
            try:
                opened = open_bag_file(file)
            except ReaderError as error:
                if len(self._paths.files) == 1:
                    raise
                failed = failed or error
                notes.append(f"{error}: the other files are read")
                continue
            self._files.append(opened)
            if opened.cut_off:
                notes.append(f"{file.name} is cut off in the middle: only its complete part is read")
            if opened.damaged:
                count = opened.damaged
                notes.append(
                    f"{file.name}: {count} part{'s' * (count != 1)} cannot be decompressed: "
                    f"{'their' if count != 1 else 'its'} messages are left out"
                )
        self.notes = tuple(notes)
        self.cut_off = any(file.cut_off for file in self._files)
        self._entries: dict[str, list[tuple[BagFile, MessageEntry]]] = {}
        # Files may follow each other (splits) or cover the same time (several recorders).
        streams = [[(entry, file) for entry in file.entries] for file in self._files]
        for entry, owner in heapq.merge(*streams, key=lambda found: found[0].time):
            self._entries.setdefault(entry.channel.topic, []).append((owner, entry))
        if not self._entries:
            reason = "cut off, and it holds no complete image" if self.cut_off else "no images"
            raise failed or ReaderError(f"{path}: not a bag that can be read: {reason}")
        self.types = {topic: found[0][1].channel.msgtype for topic, found in self._entries.items()}
        self._stores = {True: get_typestore(Stores.ROS2_HUMBLE), False: get_typestore(Stores.ROS1_NOETIC)}
        for store in self._stores.values():
            for msgtypes, definition in ((EXTRINSICS_TYPES, _EXTRINSICS), (TRANSFORM_TYPES, _TRANSFORMS)):
                for msgtype in msgtypes - set(store.types):
                    store.register(get_types_from_msg(definition, msgtype))

    def stamps(self, topic: str) -> list[int]:
        """Header stamp of each message in the order of recording, nanoseconds; 0 where it has none."""
        return [entry.stamp for _, entry in self._entries[topic]]

    def times(self, topic: str) -> list[int]:
        """Time of recording of each message, nanoseconds."""
        return [entry.time for _, entry in self._entries[topic]]

    def read(self, topic: str, number: int) -> Any:
        """Deserialise one message.

        Raises:
            ReaderError: the message is broken.
        """
        file, entry = self._entries[topic][number]
        with foreign_errors(ReaderError, f"{self._path}: message {number} of {topic} is broken"):
            data = file.read(entry.location) if entry.content is None else entry.content
            store = self._stores[entry.channel.is_cdr]
            deserialize = store.deserialize_cdr if entry.channel.is_cdr else store.deserialize_ros1
            # The definitions of these messages are the same in all versions, whatever a bag says.
            return deserialize(data, entry.channel.msgtype)
