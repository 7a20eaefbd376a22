"""Two frames: a pair folder or four files.

A pair folder holds `color0`, `color1` (.png, .jpg or .jpeg), `depth0.png`, `depth1.png` (16-bit) and `camera.json`;
0 is the previous frame and 1 is the current frame.
"""

from __future__ import annotations

from pathlib import Path

from objectflow.errors import ReaderError
from objectflow.readers.options import CameraOptions
from objectflow.readers.sequence import FramePaths, FrameSequence

COLOR_SUFFIXES = (".png", ".jpg", ".jpeg")


def is_pair(folder: Path) -> bool:
    """Whether a folder holds `color0` but no `color2`, which would make it a longer sequence."""
    return _find_color(folder, 0) is not None and _find_color(folder, 2) is None


def open_pair(folder: Path, options: CameraOptions | None = None) -> FrameSequence:
    """Open a pair folder as a sequence of two frames.

    Raises:
        ReaderError: the folder or one of its files is missing, or the camera's size differs from the images'.
        CameraError: the camera file lacks intrinsics or holds invalid ones.
        FrameError: invalid depth scale.
    """
    if not folder.is_dir():
        raise ReaderError(f"{folder}: {'not a folder' if folder.exists() else 'no such folder'}")
    colors = []
    for index in (0, 1):
        color = _find_color(folder, index)
        if color is None:
            raise ReaderError(
                f"{folder}: no color{index}.png or color{index}.jpg: a pair folder holds color0, depth0, color1, "
                "depth1 and camera.json (`objectflow run` reads sequences)"
            )
        colors.append(color)
    return open_files(colors[0], folder / "depth0.png", colors[1], folder / "depth1.png", options)


def open_files(
    prev_color: Path, prev_depth: Path, curr_color: Path, curr_depth: Path, options: CameraOptions | None = None
) -> FrameSequence:
    """Open four image files as a sequence of two frames, with the `camera.json` beside the first file.

    Raises:
        ReaderError, CameraError, FrameError: as for `open_pair`.
    """
    for path in (prev_color, prev_depth, curr_color, curr_depth):
        if not path.is_file():
            raise ReaderError(f"{path}: {'not a file' if path.exists() else 'no such file'}")
    setup = (options or CameraOptions()).resolve(prev_color.parent, prev_color)
    frames = (FramePaths(prev_color, prev_depth), FramePaths(curr_color, curr_depth))
    return FrameSequence(frames, setup.camera, setup.depth_scale)


def _find_color(folder: Path, index: int) -> Path | None:
    found = (folder / f"color{index}{suffix}" for suffix in COLOR_SUFFIXES)
    return next((path for path in found if path.is_file()), None)
