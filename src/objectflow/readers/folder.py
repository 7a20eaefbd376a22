"""A plain folder of numbered frames.

A colour and a depth image with the same number make a frame. Two layouts are supported:

- two subfolders: `color/` (or `rgb/`, `image/`, `images/`) and `depth/`, with `0001.png`, `frame_0001.jpg`, ...
- one folder, with `color` (or `colour`, `rgb`) and `depth` in the file names: `color_0001.png depth_0001.png`,
  `0001_rgb.jpg 0001_depth.png`, `frame-000001.color.png frame-000001.depth.png`, ...

See `image_numbers` for the number of a file name. Names that are time stamps give the frames their times; if colour
and depth have different stamps, they are paired by time.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from objectflow.errors import ReaderError
from objectflow.readers.assemble import MAX_NAMED, Layout, assemble
from objectflow.readers.image_numbers import Number, number_images, seconds
from objectflow.readers.options import CameraOptions
from objectflow.readers.sequence import FramePaths, FrameSequence
from objectflow.readers.timestamps import find_unit
from objectflow.readers.tum import MAX_TIME_DIFFERENCE, associate
from objectflow.storage.image_files import is_image

COLOR_FOLDERS = ("color", "colour", "rgb", "image", "images", "img")
"""Names of the folder of colour images, in any case."""
DEPTH_FOLDERS = ("depth", "depths", "depth_image", "depth_images", "aligned_depth")
"""Names of the folder of depth images, in any case."""
_COLOR_WORD = re.compile(r"colou?r|rgb", re.IGNORECASE)
_DEPTH_WORD = re.compile(r"depth", re.IGNORECASE)


class Images(NamedTuple):
    """The colour and the depth images of a folder."""

    color: list[Path]
    depth: list[Path]


def open_folder(folder: Path, options: CameraOptions | None = None, layout: Layout | None = None) -> FrameSequence:
    """Open a folder of numbered frames, sorted by number.

    Images without a counterpart are left out, and a note names them.

    Args:
        folder: the folder.
        options: the caller's.
        layout: defaults of a known layout.

    Raises:
        ReaderError: the folder holds no frames, fewer than two frames have both images, two images have the same
            number, no frame can be read, or there is no camera.
        CameraError: the camera file lacks intrinsics or holds invalid ones.
        FrameError: invalid depth scale.
    """
    images = find_images(folder)
    if not images.color and not images.depth:
        raise ReaderError(
            f"{folder}: no RGB-D frames: expected a pair folder (color0, depth0, color1, depth1), a TUM directory "
            "(rgb.txt, depth.txt) or numbered frames (color/0001.png depth/0001.png, or color_0001.png depth_0001.png)"
        )
    return open_images(folder, images, options, layout)


def open_images(
    folder: Path, images: Images, options: CameraOptions | None, layout: Layout | None = None
) -> FrameSequence:
    """Pair colour and depth images by the numbers or the stamps in their names; see `open_folder`."""
    color, depth = number_images(images.color, images.depth)
    shared = color.keys() & depth.keys()
    if len(shared) < 2:
        frames = _pair_by_time(color, depth, (options and options.max_lag) or MAX_TIME_DIFFERENCE)
        if len(frames) >= 2:
            return assemble(folder, frames, options, layout, notes=_left_out(color, depth, frames))
    if not color and not depth:
        image = (images.color or images.depth)[0]
        raise ReaderError(f"{image}: its name has no number: name the images of a frame by the number of the frame")
    alone = sorted(color.keys() ^ depth.keys())
    if alone and len(shared) < 2:
        number = alone[0]
        path, other = (color[number], "depth") if number in color else (depth[number], "colour")
        raise ReaderError(f"{path}: no {other} image with number {' '.join(map(str, number))}")
    times = _times(sorted(shared))
    frames = [
        FramePaths(color[number], depth[number], time) for number, time in zip(sorted(shared), times, strict=True)
    ]
    return assemble(folder, frames, options, layout, notes=_left_out(color, depth, frames))


def find_images(folder: Path) -> Images:
    """The colour and the depth images of a folder, in subfolders or by words in their names."""
    try:
        children = sorted(folder.iterdir())
    except OSError as error:
        raise ReaderError(f"{folder}: cannot be read: {error.strerror}") from error
    folders = {path.name.lower(): path for path in children if path.is_dir()}
    color_folder, depth_folder = (
        next((folders[name] for name in names if name in folders), None) for names in (COLOR_FOLDERS, DEPTH_FOLDERS)
    )
    if color_folder is not None and depth_folder is not None:
        return Images(list_images(color_folder), list_images(depth_folder))
    images = [path for path in children if is_image(path)]
    depth = [path for path in images if _DEPTH_WORD.search(path.stem)]
    color = [path for path in images if _COLOR_WORD.search(path.stem) and not _DEPTH_WORD.search(path.stem)]
    return Images(color, depth)


def list_images(folder: Path) -> list[Path]:
    """The images of a folder, sorted by name.

    Raises:
        ReaderError: the folder cannot be read.
    """
    try:
        return sorted(path for path in folder.iterdir() if is_image(path))
    except OSError as error:
        raise ReaderError(f"{folder}: cannot be read: {error.strerror}") from error


def _times(numbers: Sequence[Number]) -> list[float | None]:
    """Seconds of numbers that are time stamps; None for other numbers."""
    stamps = [seconds(number) for number in numbers]
    known = [float(stamp) for stamp in stamps if stamp is not None]
    if len(known) < len(stamps) or not known:
        return [None] * len(numbers)
    units = {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}[find_unit(known)]
    return [stamp / units for stamp in known]


def _pair_by_time(color: Mapping[Number, Path], depth: Mapping[Number, Path], limit: float) -> list[FramePaths]:
    """Pair images whose numbers are stamps by their times; nothing where the numbers are no stamps."""
    numbers = [sorted(images) for images in (color, depth)]
    color_times, depth_times = ([time for time in _times(group) if time is not None] for group in numbers)
    if not color_times or not depth_times:
        return []
    return [
        FramePaths(color[numbers[0][i]], depth[numbers[1][j]], color_times[i])
        for i, j in associate(color_times, depth_times, limit)
    ]


def _left_out(
    color: Mapping[Number, Path], depth: Mapping[Number, Path], frames: Sequence[FramePaths]
) -> tuple[str, ...]:
    """A note that names the images without a counterpart, if there are any."""
    used = {path for frame in frames for path in (frame.color, frame.depth)}
    notes = []
    for images, name, other in ((color, "colour", "depth"), (depth, "depth", "colour")):
        alone = [f"{path.parent.name}/{path.name}" for _, path in sorted(images.items()) if path not in used]
        if alone:
            named = ", ".join(alone[:MAX_NAMED]) + (", ..." if len(alone) > MAX_NAMED else "")
            plural = "s" * (len(alone) != 1)
            notes.append(f"{len(alone)} {name} image{plural} without a {other} image left out: {named}")
    return tuple(notes)
