"""Folders of data sets whose camera is known: 7-Scenes (and RGB-D Scenes in its format), BundleFusion and Replica."""

from __future__ import annotations

import re
from pathlib import Path

from objectflow.errors import ReaderError
from objectflow.readers.assemble import Layout
from objectflow.readers.camera_files import find_camera_file, read_camera_file
from objectflow.readers.camera_values import CameraValues, from_matrix
from objectflow.readers.folder import Images, list_images, open_folder, open_images
from objectflow.readers.options import CameraOptions
from objectflow.readers.sequence import FrameSequence
from objectflow.storage.image_files import read_size

SEVEN_SCENES_CAMERA = CameraValues(585.0, 585.0, 320.0, 240.0, (640, 480))
"""Default intrinsics of 7-Scenes, from its page."""
REPLICA_CAMERA = CameraValues(600.0, 600.0, 599.5, 339.5, (1200, 680))
"""Intrinsics of the rendered Replica sequences of NICE-SLAM."""
REPLICA_DEPTH_SCALE = 6553.5
"""Units per metre of the rendered Replica sequences."""
MAX_INFO_BYTES = 1 << 16


def is_seven_scenes(folder: Path) -> bool:
    """Whether a folder holds `frame-000000.color`, `.depth` and `.pose.txt`, as 7-Scenes and BundleFusion do."""
    return (folder / "frame-000000.pose.txt").is_file() and any(folder.glob("frame-000000.depth.*"))


def open_seven_scenes(folder: Path, options: CameraOptions | None = None) -> FrameSequence:
    """Open a sequence of 7-Scenes or BundleFusion, whose `info.txt` holds the camera.

    Raises:
        ReaderError: as for `open_folder`.
        CameraError, FrameError: invalid intrinsics or depth scale.
    """
    info = next((folder / name for name in ("info.txt", "_info.txt") if (folder / name).is_file()), None)
    if info is not None:
        return open_folder(folder, options, _bundle_fusion(info))
    note = (
        "7-Scenes: the default intrinsics of its page are used (fx = fy = 585); its depth is not registered to colour"
    )
    given = (options is not None and options.has_camera) or find_camera_file(folder) is not None
    return open_folder(folder, options, Layout(camera=SEVEN_SCENES_CAMERA, notes=() if given else (note,)))


def is_replica(folder: Path) -> bool:
    """Whether a folder holds `results/frame000000.jpg`, `results/depth000000.png` and `traj.txt`."""
    results = folder / "results"
    return (folder / "traj.txt").is_file() and any(results.glob("frame*")) and any(results.glob("depth*"))


def open_replica(folder: Path, options: CameraOptions | None = None) -> FrameSequence:
    """Open a rendered sequence of Replica, whose `cam_params.json` lies in the folder or in its parent.

    Raises:
        ReaderError: as for `open_folder`.
        CameraError, FrameError: invalid intrinsics or depth scale.
    """
    images = list_images(folder / "results")
    files = (parent / "cam_params.json" for parent in (folder, folder.resolve().parent))
    path = next((file for file in files if file.is_file()), None)
    color = [file for file in images if file.stem.startswith("frame")]
    depth = [file for file in images if file.stem.startswith("depth")]
    if path is not None:
        values = read_camera_file(path)
        layout = Layout(values.depth_scale or REPLICA_DEPTH_SCALE, values)
    elif color and read_size(color[0]) == REPLICA_CAMERA.size:
        note = f"Replica: no cam_params.json: fx = fy = {REPLICA_CAMERA.fx:g}, {REPLICA_DEPTH_SCALE:g} units per metre"
        layout = Layout(REPLICA_DEPTH_SCALE, REPLICA_CAMERA, notes=(note,))
    else:
        layout = Layout(REPLICA_DEPTH_SCALE)
    return open_images(folder, Images(color, depth), options, layout)


def _bundle_fusion(path: Path) -> Layout:
    try:
        text = path.read_bytes()[:MAX_INFO_BYTES].decode("utf-8", "replace")
    except OSError as error:
        raise ReaderError(f"{path}: cannot be read: {error.strerror}") from error
    values = dict(re.findall(r"^\s*m_(\w+)\s*=\s*(.+?)\s*$", text, re.MULTILINE))
    names = ("calibrationColorIntrinsic", "colorWidth", "colorHeight")
    missing = [f"m_{name}" for name in names if name not in values]
    if missing:
        raise ReaderError(f"{path}: {', '.join(missing)} missing")
    try:
        intrinsics = from_matrix([float(word) for word in values[names[0]].split()], str(path))
        size = int(values[names[1]]), int(values[names[2]])
        scale = float(values.get("depthShift", Layout.depth_scale))
    except ValueError as error:
        raise ReaderError(f"{path}: {error}") from error
    if not 0 < scale < float("inf"):
        raise ReaderError(f"{path}: m_depthShift must be a positive number of units per metre")
    return Layout(scale, CameraValues(*intrinsics, size))
