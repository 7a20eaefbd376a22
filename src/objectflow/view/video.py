"""`overlay.mp4`: the overlays of a run as a video."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from objectflow.errors import StorageError
from objectflow.storage.image_files import read_color

CODEC = "mp4v"
"""Four characters that name the codec, MPEG-4 part 2, which every build of OpenCV has."""


def write_video(path: Path, pictures: Sequence[Path], frame_rate: float) -> None:
    """Write pictures as the frames of an MP4 file, which appears when it is complete.

    Args:
        path: of the file; one that exists is replaced.
        pictures: files, in order; missing ones are left out. Smaller pictures are padded with white.
        frame_rate: frames per second.

    Raises:
        StorageError: OpenCV cannot write the file.
    """
    found = [picture for picture in pictures if picture.is_file()]
    if not found:
        return
    sizes = [read_color(picture).shape for picture in found]
    # Codecs need even sizes.
    height, width = (2 * ((max(size[axis] for size in sizes) + 1) // 2) for axis in (0, 1))
    temporary = path.with_name(f".{path.name}.tmp.mp4")
    writer = cv2.VideoWriter(str(temporary), cv2.VideoWriter.fourcc(*CODEC), frame_rate, (width, height))
    try:
        if not writer.isOpened():
            raise StorageError(f"cannot write {path}: OpenCV cannot encode {CODEC}")
        for picture in found:
            image = read_color(picture)
            sheet = np.full((height, width, 3), 255, np.uint8)
            sheet[: image.shape[0], : image.shape[1]] = image
            writer.write(cv2.cvtColor(sheet, cv2.COLOR_RGB2BGR))
        writer.release()
        temporary.replace(path)
    finally:
        writer.release()
        temporary.unlink(missing_ok=True)
