"""RGB-D frame sources, one kind per module; `open_source` detects the kind of a path."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

from objectflow.errors import ReaderError
from objectflow.readers.azure_kinect import is_azure_kinect, open_azure_kinect
from objectflow.readers.bag_paths import is_bag_file, is_bag_folder
from objectflow.readers.bop import is_bop, open_bop
from objectflow.readers.folder import open_folder
from objectflow.readers.known_scenes import is_replica, is_seven_scenes, open_replica, open_seven_scenes
from objectflow.readers.kubric import is_kubric, open_kubric
from objectflow.readers.options import NAMED_CAMERAS, CameraOptions
from objectflow.readers.pair import is_pair, open_files, open_pair
from objectflow.readers.record3d import is_record3d, open_record3d
from objectflow.readers.scannet import is_scannet, open_scannet
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

FILE_KINDS: tuple[tuple[Callable[[Path], bool], Callable[[Path, CameraOptions | None], FrameSource]], ...] = (
    (is_record3d, open_record3d),
    (is_azure_kinect, open_azure_kinect),
)
"""Recordings in one file, besides bags: how each is detected and opened."""
FOLDER_KINDS: tuple[tuple[Callable[[Path], bool], Callable[[Path, CameraOptions | None], FrameSource]], ...] = (
    (is_tum, open_tum),
    (is_bop, open_bop),
    (is_scannet, open_scannet),
    (is_record3d, open_record3d),
    (is_replica, open_replica),
    (is_kubric, open_kubric),
    (is_seven_scenes, open_seven_scenes),
    (is_pair, open_pair),
)
"""Layouts of folders in the order in which they are tried; any other folder must hold numbered frames."""


def open_source(
    path: str | Path,
    options: CameraOptions | None = None,
    *,
    color_topic: str | None = None,
    depth_topic: str | None = None,
) -> FrameSource:
    """Open a folder of frames, a bag or another recording; the kind is detected (`FOLDER_KINDS`, `FILE_KINDS`).

    Args:
        path: a folder, a bag file, an `.r3d` file of Record3D or an `.mkv` file of an Azure Kinect.
        options: the camera, its depth and the pairing of colour and depth.
        color_topic, depth_topic: required where a bag has several.

    Raises:
        ReaderError: the path does not exist or holds no frames, there is no camera, or topics are given for a path
            that is not a bag.
        MissingExtraError: the library that the kind needs is not installed.
        CameraError: the camera file lacks intrinsics or holds invalid ones.
        FrameError: invalid depth scale.
    """
    path = Path(path)
    if not os.path.exists(path):  # unlike the method of Path, false of a name that is too long or holds a NUL
        raise ReaderError(f"{path}: no such {'file or folder' if path.suffix else 'folder'}")
    if is_bag_file(path) or (path.is_dir() and is_bag_folder(path)):
        from objectflow.readers.bag import open_bag

        return open_bag(path, options, color_topic=color_topic, depth_topic=depth_topic)
    if color_topic is not None or depth_topic is not None:
        raise ReaderError(f"{path}: topics are for bags only (.bag, .mcap or a ROS 2 bag folder)")
    kinds = FOLDER_KINDS if path.is_dir() else FILE_KINDS if path.is_file() else ()
    for detect, open_kind in kinds:
        if detect(path):
            return open_kind(path, options)
    if not path.is_dir():
        raise ReaderError(f"{path}: not a folder or a known recording")
    return open_folder(path, options)
