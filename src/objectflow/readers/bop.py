"""A scene of the BOP benchmark: `rgb/` (or `gray/`), `depth/` and `scene_camera.json` with a camera for each image.

Source: https://github.com/thodan/bop_toolkit/blob/master/docs/bop_datasets_format.md
"""

from __future__ import annotations

from pathlib import Path

from objectflow.errors import ReaderError
from objectflow.readers.assemble import Layout
from objectflow.readers.camera_files import read_camera_file
from objectflow.readers.folder import DEPTH_FOLDERS, Images, list_images, open_images
from objectflow.readers.options import CameraOptions
from objectflow.readers.sequence import FrameSequence

SCENE_CAMERA = "scene_camera.json"


def is_bop(folder: Path) -> bool:
    """Whether a folder is a scene of BOP."""
    return (folder / SCENE_CAMERA).is_file() and (folder / "depth").is_dir()


def open_bop(folder: Path, options: CameraOptions | None = None) -> FrameSequence:
    """Open a scene of BOP; metres are value * depth_scale * 0.001.

    Raises:
        ReaderError: the images have different cameras, or as for `open_folder`.
        CameraError, FrameError: invalid intrinsics or depth scale.
    """
    color = next((folder / name for name in ("rgb", "gray") if (folder / name).is_dir()), None)
    if color is None:
        raise ReaderError(f"{folder}: no rgb/ or gray/ beside {SCENE_CAMERA}")
    options = options or CameraOptions()
    layout = Layout()
    if not options.has_camera:
        values = read_camera_file(folder / SCENE_CAMERA)
        layout = Layout(depth_scale=values.depth_scale or Layout.depth_scale, camera=values)
    return open_images(folder, Images(list_images(color), list_images(folder / DEPTH_FOLDERS[0])), options, layout)
