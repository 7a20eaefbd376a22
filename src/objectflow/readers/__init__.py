"""Where frames come from: one kind of source a file; `open_source` guesses the kind by looking."""

from __future__ import annotations

from pathlib import Path

from objectflow.errors import ReaderError
from objectflow.readers.folder import open_folder
from objectflow.readers.options import NAMED_CAMERAS, CameraOptions
from objectflow.readers.pair import is_pair, open_files, open_pair
from objectflow.readers.sequence import FramePaths, FrameSequence
from objectflow.readers.tum import is_tum, open_tum

__all__ = [
    "NAMED_CAMERAS",
    "CameraOptions",
    "FramePaths",
    "FrameSequence",
    "open_files",
    "open_folder",
    "open_pair",
    "open_source",
    "open_tum",
]


def open_source(path: str | Path, options: CameraOptions | None = None) -> FrameSequence:
    """Open a pair folder, a TUM RGB-D directory or a folder of numbered frames, whichever it is.

    Raises:
        ReaderError: no such folder, or no frames in it; no camera.
        CameraError: a camera file without the values of a camera.
        FrameError: a depth scale that is none.
    """
    path = Path(path)
    if not path.is_dir():
        raise ReaderError(f"{path}: {'not a folder' if path.exists() else 'no such folder'}")
    if is_tum(path):
        return open_tum(path, options)
    if is_pair(path):
        return open_pair(path, options)
    return open_folder(path, options)
