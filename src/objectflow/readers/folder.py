"""A plain folder of numbered frames.

A colour and a depth image with the same number make a frame. Two layouts are supported:

- two subfolders: `color/` (or `rgb/`, `image/`, `images/`) and `depth/`, with `0001.png`, `frame_0001.jpg`, ...
- one folder, with `color` (or `colour`, `rgb`) and `depth` in the file names: `color_0001.png depth_0001.png`,
  `0001_rgb.jpg 0001_depth.png`, `frame-000001.color.png frame-000001.depth.png`, ...

The frame number is the last number in the file name; it may have a decimal point (`1305031102.175304.png`).
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from decimal import Decimal
from pathlib import Path

from objectflow.errors import ReaderError
from objectflow.readers.options import CameraOptions
from objectflow.readers.pair import COLOR_SUFFIXES
from objectflow.readers.sequence import FramePaths, FrameSequence

COLOR_FOLDERS = ("color", "rgb", "image", "images")
DEPTH_FOLDER = "depth"
_COLOR_WORD = re.compile(r"colou?r|rgb", re.IGNORECASE)
_DEPTH_WORD = re.compile(r"depth", re.IGNORECASE)
_NUMBER = re.compile(r"[0-9]+(?:\.[0-9]+)?")


def open_folder(folder: Path, options: CameraOptions | None = None) -> FrameSequence:
    """Open a folder of numbered frames, sorted by number.

    Raises:
        ReaderError: the folder holds no frames, a frame lacks its depth or colour image, two images have the same
            number, or there is no camera.
        CameraError: the camera file lacks intrinsics or holds invalid ones.
        FrameError: invalid depth scale.
    """
    color, depth = _find_images(folder)
    if not color and not depth:
        raise ReaderError(
            f"{folder}: no RGB-D frames: expected a pair folder (color0, depth0, color1, depth1), a TUM directory "
            "(rgb.txt, depth.txt) or numbered frames (color/0001.png depth/0001.png, or color_0001.png depth_0001.png)"
        )
    for number, path in {**depth, **color}.items():
        if number not in color or number not in depth:
            raise ReaderError(f"{path}: no {'depth' if number in color else 'colour'} image with number {number}")
    frames = tuple(FramePaths(color[number], depth[number]) for number in sorted(color))
    setup = (options or CameraOptions()).resolve(folder, frames[0].color)
    return FrameSequence(frames, setup.camera, setup.depth_scale)


def _find_images(folder: Path) -> tuple[dict[Decimal, Path], dict[Decimal, Path]]:
    """Colour and depth images by number."""
    if (folder / DEPTH_FOLDER).is_dir():
        for name in COLOR_FOLDERS:
            if (folder / name).is_dir():
                return _by_number(_images(folder / name)), _by_number(_images(folder / DEPTH_FOLDER))
    images = _images(folder)
    depth = [path for path in images if _DEPTH_WORD.search(path.stem)]
    color = [path for path in images if _COLOR_WORD.search(path.stem) and path not in set(depth)]
    return _by_number(color), _by_number(depth)


def _images(folder: Path) -> list[Path]:
    try:
        return sorted(path for path in folder.iterdir() if path.suffix.lower() in COLOR_SUFFIXES)
    except OSError as error:
        raise ReaderError(f"{folder}: cannot be read: {error.strerror}") from error


def _by_number(paths: Iterable[Path]) -> dict[Decimal, Path]:
    found: dict[Decimal, Path] = {}
    for path in paths:
        numbers = _NUMBER.findall(path.stem)
        if not numbers:
            continue
        number = Decimal(numbers[-1])
        if number in found:
            raise ReaderError(f"{path}: {found[number].name} has the same number")
        found[number] = path
    return found
