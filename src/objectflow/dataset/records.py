"""Rows of pairs as fixed-size records at the size of training: decoded, resized, and kept where they fit."""

from __future__ import annotations

import mmap
import os
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from multiprocessing import reduction
from multiprocessing.context import get_spawning_popen
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from objectflow.dataset.concatenated import Pairs
from objectflow.dataset.moving_objects import keep_labels, without_still
from objectflow.errors import CameraError, DatasetError
from objectflow.geometry.camera import Camera

MOST_OBJECTS = 255
"""Of a row: labels are stored in 8 bits."""
OBJECT_NUMBERS = 11
"""Label, seen in both frames, X, T, R."""
_IMAGES = ("prev_color", "curr_color", "prev_depth", "curr_depth", "prev_labels", "curr_labels")

Records = NDArray[Any]


def record_type(height: int, width: int) -> np.dtype[Any]:
    """The bytes of one pair: images as stored, depth in its row's units."""
    return np.dtype(
        [("filled", "u1"), ("count", "i4"), ("intrinsics", "f4", (4,)), ("depth_scale", "f4")]
        + [("objects", "f4", (MOST_OBJECTS, OBJECT_NUMBERS)), ("camera_motion", "f4", (4, 4))]
        + [(name, "u1", (height, width, 3)) for name in _IMAGES[:2]]
        + [(name, "u2", (height, width)) for name in _IMAGES[2:4]]
        + [(name, "u1", (height, width)) for name in _IMAGES[4:]]
    )


class RecordReader:
    """Reads rows of a part by number; keeps as many of them, decoded and resized, as fit into a number of bytes.

    The kept records lie in a file without a name, which worker processes share and which vanishes with the last of
    them, however they end. Where the temporary folder has no room, nothing is kept.
    """

    def __init__(self, shards: Pairs, size: tuple[int, int], cache_bytes: int, *, exact: bool) -> None:
        """Prepare to read.

        Args:
            shards: the rows.
            size: (H, W) of the records.
            cache_bytes: how many bytes of records may be kept.
            exact: rows of another size are refused, not resized.
        """
        self.shards, self.type, self.exact = shards, record_type(*size), exact
        self.kept = min(len(shards), cache_bytes // self.type.itemsize)
        self._file = _reserve(self.kept * self.type.itemsize)
        self._cache = self._map()

    def read(self, rows: Sequence[int]) -> Records:
        """(len(rows),) records.

        Raises:
            DatasetError: a row that is broken, or of another size where that is refused.
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
                # Last, so that another process never reads half a record.
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
    """An unnamed temporary file of that many bytes, or None where there is no room for twice as many."""
    if size == 0 or shutil.disk_usage(tempfile.gettempdir()).free < 2 * size:
        return None
    file = tempfile.TemporaryFile(prefix="objectflow-")  # noqa: SIM115 - it lives as long as the reader
    try:
        os.posix_fallocate(file.fileno(), 0, size)  # a page that the disk cannot give later would kill the process
    except OSError:
        file.close()
        return None
    return file


def _fill(record: Records, columns: Mapping[str, Any], where: str, exact: bool) -> None:
    """Decode a row's columns into a (1,) record."""
    try:
        height, width = record.dtype["prev_labels"].shape
        stored = Camera.from_dict(columns["camera"], where=where)
        if exact and (stored.width, stored.height) != (width, height):
            raise ValueError(f"{stored.width}x{stored.height}, not {width}x{height} as the first row: give a size")
        camera = stored.scaled(width, height)
        record["intrinsics"] = camera.fx, camera.fy, camera.cx, camera.cy
        record["depth_scale"] = columns["camera"]["depth_scale"]
        objects = without_still(columns)
        kept = {int(entry["label"]) for entry in objects}
        for name in _IMAGES:
            image = _decode(columns[name], stored)
            if len(objects) < len(columns["objects"]) and name.endswith("labels"):
                image = keep_labels(image, kept)
            if name.endswith("color"):
                record[name] = _resized_color(image, width, height)[..., ::-1]
            else:
                record[name] = _nearest(image, width, height)
        record["camera_motion"] = np.reshape(columns.get("camera_motion") or np.eye(4), (4, 4))
        record["filled"], record["count"] = 0, len(objects)
        for k, entry in enumerate(objects):
            vectors = (entry["center"], entry["translation"], entry["rotation_vector"])
            record["objects"][0, k] = [entry["label"], entry["in_both"], *(x for vector in vectors for x in vector)]
    except (KeyError, TypeError, ValueError, IndexError, cv2.error, CameraError) as error:
        reason = f"{error.args[0]} is missing" if isinstance(error, KeyError) else error
        raise DatasetError(f"{where}: not a row of pairs: {reason}") from error


def _decode(data: bytes, camera: Camera) -> NDArray[Any]:
    # OpenCV fills the missing rows of a cut-off PNG with zeros and says nothing.
    if data[-8:-4] != b"IEND":
        raise ValueError("an image is not a whole PNG")
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if image is None or image.shape[:2] != (camera.height, camera.width):
        raise ValueError("an image cannot be decoded, or has not the camera's size")
    return image


def _resized_color(image: NDArray[Any], width: int, height: int) -> NDArray[Any]:
    """By area, as `RgbdFrame.resized` does it."""
    if image.shape[:2] == (height, width):
        return image
    shrink = width < image.shape[1]
    return np.asarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA if shrink else cv2.INTER_LINEAR))


def _nearest(image: NDArray[Any], width: int, height: int) -> NDArray[Any]:
    """By nearest neighbour at the pixels' centres, as `RgbdFrame.resized` takes depth: no two depths are mixed."""
    if image.shape == (height, width):
        return image
    rows = ((np.arange(height) + 0.5) * image.shape[0] / height).astype(int)
    columns = ((np.arange(width) + 0.5) * image.shape[1] / width).astype(int)
    return np.asarray(image[rows[:, None], columns[None, :]])
