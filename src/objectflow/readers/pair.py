"""Two frames: a pair folder or four files.

A pair folder holds `color0`, `color1`, `depth0`, `depth1`, in any format of `storage.image_files`, and a camera file;
0 is the previous frame and 1 is the current frame.
"""

from __future__ import annotations

from pathlib import Path

from objectflow.errors import ReaderError
from objectflow.readers.assemble import assemble
from objectflow.readers.options import CameraOptions
from objectflow.readers.sequence import FramePaths, FrameSequence
from objectflow.storage.image_files import IMAGE_SUFFIXES

_SUFFIXES = (".png", ".jpg", ".jpeg", *sorted(IMAGE_SUFFIXES - {".png", ".jpg", ".jpeg"}))


def is_pair(folder: Path) -> bool:
    """Whether a folder holds `color0` but no `color2`, which would make it a longer sequence."""
    return _find_image(folder, "color0") is not None and _find_image(folder, "color2") is None


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
        color = _find_image(folder, f"color{index}")
        if color is None:
            raise ReaderError(
                f"{folder}: no color{index}.png or color{index}.jpg: a pair folder holds color0, depth0, color1, "
                "depth1 and camera.json (`objectflow run` reads sequences)"
            )
        colors.append(color)
    depths = [_find_image(folder, name) or folder / f"{name}.png" for name in ("depth0", "depth1")]
    return open_files(colors[0], depths[0], colors[1], depths[1], options)


def open_files(
    prev_color: Path, prev_depth: Path, curr_color: Path, curr_depth: Path, options: CameraOptions | None = None
) -> FrameSequence:
    """Open four image files as a sequence of two frames, with the camera file beside the first file.

    Raises:
        ReaderError, CameraError, FrameError: as for `open_pair`.
    """
    for path in (prev_color, prev_depth, curr_color, curr_depth):
        if not path.is_file():
            raise ReaderError(f"{path}: {'not a file' if path.exists() else 'no such file'}")
    frames = (FramePaths(prev_color, prev_depth), FramePaths(curr_color, curr_depth))
    return assemble(prev_color.parent, frames, options, strict=True)


def _find_image(folder: Path, stem: str) -> Path | None:
    """The image of a name, whatever the case of its name and suffix."""
    exact = next((path for suffix in _SUFFIXES if (path := folder / f"{stem}{suffix}").is_file()), None)
    if exact is not None or not folder.is_dir():
        return exact
    found = (path for path in sorted(folder.iterdir()) if path.stem.lower() == stem)
    return next((path for path in found if path.suffix.lower() in IMAGE_SUFFIXES and path.is_file()), None)
