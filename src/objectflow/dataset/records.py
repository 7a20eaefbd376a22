"""Pairs as records of fixed size, decoded and resized for training, with a cache of as many as fit."""

from __future__ import annotations

import mmap
import os
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from multiprocessing import reduction
from multiprocessing.context import get_spawning_popen
from typing import Any

import numpy as np
from numpy.typing import NDArray

from objectflow.dataset.concatenated import Pairs
from objectflow.dataset.moving_objects import keep_labels, without_static
from objectflow.dataset.schema import PairObject, check_pose
from objectflow.errors import DatasetError
from objectflow.geometry.camera import Camera, check_depth_scale
from objectflow.geometry.resample import resize_color, resize_nearest
from objectflow.storage.foreign import located_errors
from objectflow.storage.images import decode_png

MAX_OBJECTS = 255
"""Maximum number of objects in a row: labels are stored in 8 bits."""
OBJECT_NUMBERS = 11
"""Numbers per object: label, whether it is visible in both frames, X, T, R."""
_IMAGES = ("prev_color", "curr_color", "prev_depth", "curr_depth", "prev_labels", "curr_labels")

Records = NDArray[Any]


def record_type(height: int, width: int) -> np.dtype[Any]:
    """The memory layout of one pair: images as stored, depth in the units of its row."""
    return np.dtype(
        [("filled", "u1"), ("count", "i4"), ("intrinsics", "f4", (4,)), ("depth_scale", "f4")]
        + [("objects", "f4", (MAX_OBJECTS, OBJECT_NUMBERS)), ("camera_motion", "f4", (4, 4))]
        + [(name, "u1", (height, width, 3)) for name in _IMAGES[:2]]
        + [(name, "u2", (height, width)) for name in _IMAGES[2:4]]
        + [(name, "u1", (height, width)) for name in _IMAGES[4:]]
    )


class RecordReader:
    """Reads rows of a part by number and caches as many decoded records as fit into a number of bytes.

    The cache is an unnamed file, which worker processes share and which disappears with the last of them, however they
    end. Without space in the temporary folder, nothing is cached.
    """

    def __init__(self, shards: Pairs, size: tuple[int, int], cache_bytes: int, *, exact: bool) -> None:
        """Prepare to read.

        Args:
            shards: the rows.
            size: (H, W) of the records.
            cache_bytes: maximum size of the cache.
            exact: whether rows of another size are refused instead of resized.
        """
        self.shards, self.type, self.exact = shards, record_type(*size), exact
        self.kept = min(len(shards), cache_bytes // self.type.itemsize)
        self._file = _reserve(self.kept * self.type.itemsize)
        self._cache = self._map()

    def read(self, rows: Sequence[int]) -> Records:
        """(len(rows),) records.

        Raises:
            DatasetError: a row is broken, or has another size although `exact` is set.
        """
        records = np.empty(len(rows), self.type)
        for i, row in enumerate(rows):
            if row < len(self._cache) and self._cache[row]["filled"]:
                records[i] = self._cache[row]
                continue
            columns, where = self.shards.raw(row)
            _fill(records[i : i + 1], columns, where, self.exact)
            if row < len(self._cache):
                self._cache[row] = records[i]
                # Set last, so that another process never reads a partial record.
                self._cache[row]["filled"] = 1
        return records

    def _map(self) -> Records:
        if self._file is None:
            return np.empty(0, self.type)
        return np.frombuffer(mmap.mmap(self._file.fileno(), 0), self.type)

    def __getstate__(self) -> dict[str, Any]:
        state = {**self.__dict__, "_cache": None, "_file": None}
        if self._file is not None and get_spawning_popen() is not None:
            state["_file"] = reduction.DupFd(self._file.fileno())
        return state

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        if self._file is not None:
            self._file = os.fdopen(state["_file"].detach(), "r+b")
        self._cache = self._map()


def _reserve(size: int) -> Any:
    """An unnamed temporary file of a size in bytes, or None without space for twice as many."""
    if size == 0 or shutil.disk_usage(tempfile.gettempdir()).free < 2 * size:
        return None
    file = tempfile.TemporaryFile(prefix="objectflow-")  # noqa: SIM115 - open as long as the reader exists
    try:
        os.posix_fallocate(file.fileno(), 0, size)  # otherwise a full disk would kill the process later
    except OSError:
        file.close()
        return None
    return file


def _fill(record: Records, columns: Mapping[str, Any], where: str, exact: bool) -> None:
    """Decode the columns of a row into a (1,) record."""
    with located_errors(DatasetError, f"{where}: not a row of pairs"):
        height, width = record.dtype["prev_labels"].shape
        stored = Camera.from_dict(columns["camera"], where=where)
        if exact and (stored.width, stored.height) != (width, height):
            raise ValueError(f"{stored.width}x{stored.height}, not {width}x{height} as the first row: give a size")
        camera = stored.scaled(width, height)
        record["intrinsics"] = camera.fx, camera.fy, camera.cx, camera.cy
        check_depth_scale(columns["camera"]["depth_scale"])
        record["depth_scale"] = columns["camera"]["depth_scale"]
        for entry in columns["objects"]:
            PairObject.from_dict(entry)
        if columns.get("camera_motion") is not None:
            check_pose(np.reshape(columns["camera_motion"], (4, 4)), "camera_motion")
        objects = without_static(columns)
        kept = {int(entry["label"]) for entry in objects}
        for name in _IMAGES:
            image = decode_png(columns[name], name, size=(stored.width, stored.height))
            if len(objects) < len(columns["objects"]) and name.endswith("labels"):
                image = keep_labels(image, kept)
            resize = resize_color if name.endswith("color") else resize_nearest
            record[name] = resize(image, (height, width))
        record["camera_motion"] = np.reshape(columns.get("camera_motion") or np.eye(4), (4, 4))
        record["filled"], record["count"] = 0, len(objects)
        for k, entry in enumerate(objects):
            vectors = (entry["center"], entry["translation"], entry["rotation_vector"])
            record["objects"][0, k] = [entry["label"], entry["in_both"], *(x for vector in vectors for x in vector)]
