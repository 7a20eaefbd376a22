"""RGB-D frame sources, one kind per module; `open_source` detects the kind of a path."""

from __future__ import annotations

from pathlib import Path

from objectflow.errors import ReaderError
from objectflow.readers.folder import open_folder
from objectflow.readers.options import NAMED_CAMERAS, CameraOptions
from objectflow.readers.pair import is_pair, open_files, open_pair
from objectflow.readers.sequence import CutOffWarning, FramePaths, FrameSequence, FrameSource
from objectflow.readers.tum import is_tum, open_tum

__all__ = [
    "NAMED_CAMERAS",
    "CameraOptions",
    "CutOffWarning",
    "FramePaths",
    "FrameSequence",
    "FrameSource",
    "open_files",
    "open_folder",
    "open_pair",
    "open_source",
    "open_tum",
]

BAG_SUFFIXES = (".bag", ".mcap", ".db3")


def is_bag(path: Path) -> bool:
    """Whether a path is a bag file or a ROS 2 bag folder."""
    if path.is_file():
        return path.suffix in BAG_SUFFIXES
    return (path / "metadata.yaml").is_file() or any(any(path.glob(f"*{end}")) for end in BAG_SUFFIXES[1:])


def open_source(
    path: str | Path,
    options: CameraOptions | None = None,
    *,
    color_topic: str | None = None,
    depth_topic: str | None = None,
) -> FrameSource:
    """Open a pair folder, a TUM RGB-D directory, a folder of numbered frames or a bag; the kind is detected.

    Args:
        path: a folder, or a bag file.
        options: the camera.
        color_topic, depth_topic: required where a bag has several.

    Raises:
        ReaderError: the folder does not exist or holds no frames, there is no camera, or topics are given for a path
            that is not a bag.
        MissingExtraError: the path is a bag and rosbags is not installed.
        CameraError: the camera file lacks intrinsics or holds invalid ones.
        FrameError: invalid depth scale.
    """
    path = Path(path)
    if path.exists() and is_bag(path):
        from objectflow.readers.bag import open_bag

        return open_bag(path, options, color_topic=color_topic, depth_topic=depth_topic)
    if color_topic is not None or depth_topic is not None:
        raise ReaderError(f"{path}: topics are for bags only (.bag, .mcap or a ROS 2 bag folder)")
    if not path.is_dir():
        raise ReaderError(f"{path}: {'not a folder' if path.exists() else 'no such folder'}")
    if is_tum(path):
        return open_tum(path, options)
    if is_pair(path):
        return open_pair(path, options)
    return open_folder(path, options)
