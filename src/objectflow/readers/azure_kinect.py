"""Recordings of an Azure Kinect (`.mkv`) by its own library, which brings depth to the pixels of colour."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from objectflow.errors import MissingExtraError, ReaderError
from objectflow.frame import RgbdFrame
from objectflow.geometry.camera import Camera
from objectflow.readers.camera_values import from_matrix
from objectflow.readers.options import DEFAULT_DEPTH_SCALE, CameraOptions
from objectflow.storage.coded_images import decode
from objectflow.storage.foreign import foreign_errors
from objectflow.storage.image_files import to_metres
from objectflow.typing import UInt8Array

SUFFIX = ".mkv"


def is_azure_kinect(path: Path) -> bool:
    """Whether a path is an `.mkv` file."""
    return path.is_file() and path.suffix.lower() == SUFFIX


@dataclass(frozen=True, eq=False)
class KinectSequence:
    """The frames of a recording that have colour and depth, decoded on access.

    Attributes:
        path: the file.
        playback: of pyk4a.
        camera: of colour.
        stamps: time of each colour image, microseconds.
        options: the caller's.
        notes: see `FrameSource`.
    """

    path: Path
    playback: Any
    camera: Camera
    stamps: tuple[int, ...]
    options: CameraOptions
    notes: tuple[str, ...]

    @property
    def depth_scale(self) -> float:
        """Depth is in millimetres."""
        return self.options.depth_scale or DEFAULT_DEPTH_SCALE

    @property
    def cuts(self) -> tuple[int, ...]:
        """A recording is never restarted."""
        return ()

    def __len__(self) -> int:
        return len(self.stamps)

    def __getitem__(self, index: int) -> RgbdFrame:
        """Decode a frame.

        Raises:
            ReaderError: a broken frame.
            FrameError: the images do not make a valid frame.
        """
        name = f"{self.path} at {self.stamps[index] / 1e6:.3f} s"
        with foreign_errors(ReaderError, f"{name}: cannot be read"):
            # The capture at a time is the next one after it.
            self.playback.seek(self.stamps[index])
            capture = self.playback.get_next_capture()
            color, depth = np.asarray(capture.color), np.asarray(capture.transformed_depth)
        metres = to_metres(depth, depth_scale=self.depth_scale, max_depth=self.options.max_depth)
        return RgbdFrame(_to_rgb(color, self.path), metres, self.camera, timestamp=self.timestamp(index), name=name)

    def __iter__(self) -> Iterator[RgbdFrame]:
        return (self[index] for index in range(len(self)))

    def timestamp(self, index: int) -> float:
        """Time of the colour image, seconds."""
        return self.stamps[index] / 1e6


def open_azure_kinect(path: Path, options: CameraOptions | None = None) -> KinectSequence:
    """Open a recording.

    Raises:
        MissingExtraError: pyk4a or the k4a library is not installed.
        ReaderError: not a recording of an Azure Kinect, or it lacks colour or depth.
        CameraError: invalid intrinsics.
    """
    options = options or CameraOptions()
    try:
        import pyk4a
    except ImportError as error:
        raise MissingExtraError(
            f"{path}: Azure Kinect recordings need pyk4a and the k4a library; or convert the recording to folders "
            "with Open3D's azure_kinect_mkv_reader.py (--input FILE --output FOLDER) and read FOLDER"
        ) from error
    with foreign_errors(ReaderError, f"{path}: not a recording of an Azure Kinect that can be read"):
        playback = pyk4a.PyK4APlayback(path)
        playback.open()
        matrix = playback.calibration.get_camera_matrix(pyk4a.CalibrationType.COLOR)
        stamps, count, size = [], 0, None
        while True:
            try:
                capture = playback.get_next_capture()
            except EOFError:
                break
            count += 1
            if capture.color is None or capture.depth is None:
                continue
            stamps.append(int(capture.color_timestamp_usec))
            if size is None:
                height, width = np.asarray(capture.transformed_depth).shape
                size = width, height
    if size is None or len(stamps) < 2:
        raise ReaderError(f"{path}: {len(stamps)} frames with colour and depth: a pair needs two")
    fx, fy, cx, cy = from_matrix(matrix, str(path))
    camera = Camera(*size, fx, fy, cx, cy)
    if options.has_camera:
        camera = options.fit(size, path.parent, str(path)).camera
    alone = count - len(stamps)
    notes = (f"{alone} of {count} captures without colour or depth left out",) if alone else ()
    return KinectSequence(path, playback, camera, tuple(stamps), options, notes)


def _to_rgb(color: Any, path: Path) -> UInt8Array:
    """RGB of a colour image in BGRA32, or of one that is compressed as JPEG."""
    if color.ndim == 1 or (color.ndim == 2 and min(color.shape) == 1):
        return np.ascontiguousarray(decode(color.tobytes(), path)[..., :3], dtype=np.uint8)
    if color.ndim != 3 or color.shape[2] != 4:
        raise ReaderError(f"{path}: colour must be recorded as MJPG or BGRA32")
    return np.ascontiguousarray(color[..., 2::-1], dtype=np.uint8)
