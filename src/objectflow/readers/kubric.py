"""A scene rendered by Kubric: `rgba_00000.png`, `depth_00000.tiff` and the camera in `metadata.json`.

Kubric's depth is the distance from the camera's centre and is converted to planar z.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from objectflow.errors import CameraError, ReaderError
from objectflow.readers.assemble import Layout
from objectflow.readers.camera_values import CameraValues, number
from objectflow.readers.folder import Images, list_images, open_images
from objectflow.readers.options import CameraOptions
from objectflow.readers.sequence import FrameSequence
from objectflow.storage.foreign import foreign_errors
from objectflow.storage.image_files import read_size

METADATA = "metadata.json"
MAX_METADATA_BYTES = 1 << 26


def is_kubric(folder: Path) -> bool:
    """Whether a folder is an exported scene of Kubric."""
    return (folder / METADATA).is_file() and any(folder.glob("rgba_*")) and any(folder.glob("depth_*"))


def open_kubric(folder: Path, options: CameraOptions | None = None) -> FrameSequence:
    """Open a scene of Kubric; one unit is a metre.

    Raises:
        ReaderError: as for `open_folder`, or `metadata.json` cannot be read.
        CameraError, FrameError: invalid intrinsics or depth scale.
    """
    images = list_images(folder)
    color, depth = ([path for path in images if path.stem.startswith(word)] for word in ("rgba_", "depth_"))
    camera = None
    if color and not (options is not None and options.has_camera):
        camera = _camera(folder / METADATA, read_size(color[0]))
    note = "Kubric: depth is the distance from the camera's centre: converted to planar z"
    return open_images(folder, Images(color, depth), options, Layout(camera=camera, ray_length=True, notes=(note,)))


def _camera(path: Path, size: tuple[int, int]) -> CameraValues:
    try:
        if path.stat().st_size > MAX_METADATA_BYTES:
            raise ReaderError(f"{path}: too large (at most {MAX_METADATA_BYTES >> 20} MiB)")
        data = path.read_bytes()
    except OSError as error:
        raise ReaderError(f"{path}: cannot be read: {error.strerror}") from error
    with foreign_errors(ReaderError, f"{path}: not a JSON file"):
        values: Any = json.loads(data)
    camera = values.get("camera") if isinstance(values, dict) else None
    camera = camera if isinstance(camera, dict) else {}
    missing = [name for name in ("focal_length", "sensor_width") if name not in camera]
    if missing:
        raise CameraError(f"{path}: camera {', '.join(missing)} missing")
    focal, sensor = (number(camera[name], name, str(path)) for name in ("focal_length", "sensor_width"))
    if sensor <= 0:
        raise CameraError(f"{path}: camera sensor_width must be positive")
    pixels = focal / sensor * size[0]
    # The principal point is the centre of the image; pixel centres are whole numbers.
    return CameraValues(pixels, pixels, (size[0] - 1) / 2, (size[1] - 1) / 2, size)
