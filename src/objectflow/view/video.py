"""`overlay.mp4`: the overlays of a run as a video."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from objectflow.errors import StorageError
from objectflow.runtime.quiet import silence_stderr
from objectflow.storage.files import new_file
from objectflow.storage.image_files import read_color

CODEC = "mp4v"
"""Four characters that name the codec, MPEG-4 part 2, which every build of OpenCV has."""

MIN_FREE_BYTES = 1 << 16
"""A disk with less free space, in bytes, is full: some file systems keep their last blocks."""


def write_video(path: Path, pictures: Sequence[Path], frame_rate: float) -> None:
    """Write pictures as the frames of an MP4 file, which appears when it is complete.

    Args:
        path: of the file; one that exists is replaced.
        pictures: files, in order; missing ones are left out. Smaller pictures are padded with white.
        frame_rate: frames per second.

    Raises:
        StorageError: the disk is full, or OpenCV cannot encode the video.
    """
    found = [picture for picture in pictures if picture.is_file()]
    if not found:
        return
    sizes = [read_color(picture).shape for picture in found]
    # Codecs need even sizes.
    height, width = (2 * ((max(size[axis] for size in sizes) + 1) // 2) for axis in (0, 1))
    with new_file(path) as written:
        with silence_stderr():  # OpenCV's encoder prints its own messages
            _encode(written, found, frame_rate, (width, height))
            frames = _frame_count(written)
        # The encoder writes without an error on a full disk.
        if frames != len(found):
            full = shutil.disk_usage(written.parent).free < MIN_FREE_BYTES
            reason = "No space left on device" if full else f"OpenCV cannot encode {CODEC}"
            raise StorageError(f"cannot write {path}: {reason}")


def _encode(path: Path, pictures: Sequence[Path], frame_rate: float, size: tuple[int, int]) -> None:
    """Write pictures, padded with white to (width, height)."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*CODEC), frame_rate, size)
    try:
        for picture in pictures:
            image = read_color(picture)
            sheet = np.full((size[1], size[0], 3), 255, np.uint8)
            sheet[: image.shape[0], : image.shape[1]] = image
            writer.write(cv2.cvtColor(sheet, cv2.COLOR_RGB2BGR))
    finally:
        writer.release()


def _frame_count(path: Path) -> int:
    """Number of frames that the index of a video declares; 0 if there is no whole video."""
    video = cv2.VideoCapture(str(path))
    try:
        return int(video.get(cv2.CAP_PROP_FRAME_COUNT)) if video.isOpened() else 0
    finally:
        video.release()
