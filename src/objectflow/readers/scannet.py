"""An exported scan of ScanNet: `color/`, `depth/` and the intrinsics of both cameras, in millimetres.

Colour has another resolution than depth and is resampled to the pixels of depth. The two cameras have the same centre
and orientation: the published extrinsics between them are the identity.
"""

from __future__ import annotations

from pathlib import Path

from objectflow.readers.assemble import Layout
from objectflow.readers.camera_files import read_camera_file
from objectflow.readers.camera_values import CameraValues
from objectflow.readers.folder import find_images, open_images
from objectflow.readers.options import CameraOptions
from objectflow.readers.sequence import FrameSequence
from objectflow.storage.image_files import read_size

_NAMES = ("intrinsic/intrinsic_{}.txt", "intrinsic_{}.txt", "intrinsics_{}.txt")
COLOR_SIZE = (1296, 968)
"""Size of the colour images that the published intrinsics belong to, in pixels."""


def is_scannet(folder: Path) -> bool:
    """Whether a folder holds the intrinsics of both cameras."""
    return _intrinsics(folder, "color") is not None and _intrinsics(folder, "depth") is not None


def open_scannet(folder: Path, options: CameraOptions | None = None) -> FrameSequence:
    """Open an exported scan; the camera is that of depth.

    Raises:
        ReaderError: as for `open_folder`.
        CameraError, FrameError: invalid intrinsics or depth scale.
    """
    images = find_images(folder)
    color, depth = _intrinsics(folder, "color"), _intrinsics(folder, "depth")
    if color is None or depth is None or not images.color:
        return open_images(folder, images, options)
    color_camera = read_camera_file(color)
    # Exports may reduce the images and keep the intrinsics.
    if color_camera.cx > 0.75 * read_size(images.color[0])[0]:
        color_camera = CameraValues(color_camera.fx, color_camera.fy, color_camera.cx, color_camera.cy, COLOR_SIZE)
    layout = Layout(
        camera=color_camera,
        depth_camera=read_camera_file(depth),
        notes=("ScanNet: colour is resampled to the pixels of the depth camera",),
    )
    return open_images(folder, images, options, layout)


def _intrinsics(folder: Path, kind: str) -> Path | None:
    return next((folder / name.format(kind) for name in _NAMES if (folder / name.format(kind)).is_file()), None)
