"""Camera files in the forms in which people have them: JSON, YAML, a matrix or four numbers, and COLMAP models."""

from __future__ import annotations

import json
import re
import struct
from pathlib import Path
from typing import Any

from objectflow.errors import CameraError, ReaderError
from objectflow.readers.camera_mappings import from_mapping
from objectflow.readers.camera_values import CameraValues, from_matrix, number
from objectflow.storage.archives import npy_array
from objectflow.storage.array_files import is_npy
from objectflow.storage.foreign import foreign_errors

CAMERA_FILES = (
    "camera.json",
    "camera_intrinsic.json",
    "intrinsic.json",
    "intrinsics.json",
    "camera_info.yaml",
    "camera_info.yml",
    "camera_info.json",
    "camera.yaml",
    "K.txt",
    "K.npy",
    "intrinsics.txt",
    "camera-intrinsics.txt",
    "camera_intrinsics.txt",
    "intrinsic_color.txt",
    "intrinsic/intrinsic_color.txt",
    "cam_params.json",
    "calibration.txt",
    "cameras.txt",
    "cameras.bin",
    "sparse/0/cameras.txt",
    "sparse/0/cameras.bin",
)
"""Names of the camera file beside the images, in the order in which they are looked for."""
MAX_BYTES = 1 << 24
"""Largest camera file, in bytes."""
MAX_YAML_BYTES = 1 << 18
"""Largest YAML file, in bytes."""
COLMAP_MODELS: dict[str, tuple[int, str, str]] = {
    "SIMPLE_PINHOLE": (0, "f cx cy", ""),
    "PINHOLE": (1, "fx fy cx cy", ""),
    "SIMPLE_RADIAL": (2, "f cx cy k1", "plumb_bob"),
    "RADIAL": (3, "f cx cy k1 k2", "plumb_bob"),
    "OPENCV": (4, "fx fy cx cy k1 k2 p1 p2", "plumb_bob"),
    "OPENCV_FISHEYE": (5, "fx fy cx cy k1 k2 k3 k4", "equidistant"),
    "FULL_OPENCV": (6, "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6", "rational_polynomial"),
}
"""Camera models of COLMAP: number, parameters, and the distortion model by its name in ROS."""
_DISTORTION_ORDER = {"plumb_bob": 4, "equidistant": 4, "rational_polynomial": 8}


def find_camera_file(folder: Path) -> Path | None:
    """The first of `CAMERA_FILES` in a folder, or None."""
    return next((folder / name for name in CAMERA_FILES if (folder / name).is_file()), None)


def read_camera_file(path: Path) -> CameraValues:
    """Read a camera file of any known form; see `camera_mappings` for the keys of JSON and YAML files.

    Raises:
        ReaderError: the file is missing, cannot be read or has an unknown form.
        CameraError: missing or invalid values.
        FrameError: a depth scale that is no positive number.
    """
    data = _read(path)
    where = str(path)
    if is_npy(data):
        with foreign_errors(ReaderError, f"{path}: not an NPY file that can be read"):
            values = npy_array(data)
        return CameraValues(*_from_numbers(values.ravel().tolist(), where))
    if path.suffix.lower() == ".bin":
        return _colmap_binary(data, where)
    try:
        text = data.decode("utf-8-sig").strip()
    except UnicodeDecodeError as error:
        raise ReaderError(f"{path}: not a camera file: neither text nor a matrix of NumPy") from error
    if path.suffix.lower() == ".json" or text.startswith("{"):
        return from_mapping(_mapping(_json(text, path), path), where)
    lines = [line.split("#", 1)[0].strip() for line in text.splitlines()]
    lines = [line for line in lines if line]
    cameras = [words for line in lines if len(words := line.split()) > 4 and words[1] in COLMAP_MODELS]
    if cameras:
        return _colmap_text(cameras, where)
    words = re.sub(r"[\[\](),;]", " ", " ".join(lines)).split()
    try:
        return CameraValues(*_from_numbers([float(word) for word in words], where))
    except ValueError:
        return from_mapping(_mapping(_yaml(text, path), path), where)


def _read(path: Path) -> bytes:
    try:
        if not path.is_file() and path.exists():
            raise ReaderError(f"{path}: a camera file must be a regular file")
        if path.stat().st_size > MAX_BYTES:
            raise ReaderError(f"{path}: too large for a camera file (at most {MAX_BYTES >> 20} MiB)")
        return path.read_bytes()
    except FileNotFoundError:
        raise ReaderError(f"{path}: no such camera file") from None
    except (OSError, ValueError) as error:  # ValueError: a path with a NUL
        raise ReaderError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from error


def _json(text: str, path: Path) -> Any:
    with foreign_errors(ReaderError, f"{path}: not a JSON file"):
        return json.loads(text)


def _yaml(text: str, path: Path) -> Any:
    if len(text) > MAX_YAML_BYTES:
        raise ReaderError(f"{path}: too large for a YAML camera file (at most {MAX_YAML_BYTES >> 10} KiB)")
    import yaml  # slow to import, and most camera files are JSON

    # OpenCV writes a directive and tags that are not part of YAML.
    plain = "\n".join(line for line in text.splitlines() if not line.startswith("%"))
    with foreign_errors(ReaderError, f"{path}: not a camera file (JSON, YAML, a 3x3 matrix or fx fy cx cy)"):
        return next(iter(yaml.safe_load_all(plain.replace("!!opencv-matrix", ""))), None)


def _mapping(values: Any, path: Path) -> dict[str, Any]:
    if not isinstance(values, dict):
        raise ReaderError(f"{path}: expected a JSON object with width, height, fx, fy, cx, cy")
    return {str(key): value for key, value in values.items()}


def _from_numbers(values: list[float], where: str) -> tuple[float, float, float, float]:
    if len(values) == 4:
        fx, fy, cx, cy = (
            number(value, name, where) for value, name in zip(values, ["fx", "fy", "cx", "cy"], strict=True)
        )
        return fx, fy, cx, cy
    if len(values) in (9, 12, 16):
        return from_matrix(values, where)
    raise CameraError(f"{where}: expected a 3x3 matrix or the four numbers fx fy cx cy, not {len(values)} numbers")


def _colmap_text(cameras: list[list[str]], where: str) -> CameraValues:
    if len(cameras) > 1:
        raise CameraError(f"{where}: {len(cameras)} cameras in the COLMAP model: one camera is needed")
    _, model, width, height, *parameters = cameras[0]
    try:
        return _colmap(model, (int(width), int(height)), [float(word) for word in parameters], where)
    except ValueError:
        raise CameraError(f"{where}: expected `CAMERA_ID MODEL WIDTH HEIGHT PARAMETERS` of COLMAP") from None


def _colmap_binary(data: bytes, where: str) -> CameraValues:
    by_number = {number: name for name, (number, _, _) in COLMAP_MODELS.items()}
    try:
        count, _, model, width, height = struct.unpack_from("<QiiQQ", data)
        if count != 1:
            raise CameraError(f"{where}: {count} cameras in the COLMAP model: one camera is needed")
        if model not in by_number:
            raise CameraError(f"{where}: COLMAP camera model {model} is not supported: undistort the images")
        length = len(COLMAP_MODELS[by_number[model]][1].split())
        return _colmap(by_number[model], (width, height), list(struct.unpack_from(f"<{length}d", data, 32)), where)
    except struct.error as error:
        raise ReaderError(f"{where}: not a COLMAP cameras.bin: {error}") from error


def _colmap(model: str, size: tuple[int, int], parameters: list[float], where: str) -> CameraValues:
    names = COLMAP_MODELS[model][1].split()
    if len(parameters) != len(names):
        raise CameraError(f"{where}: {model} of COLMAP has {len(names)} parameters, this has {len(parameters)}")
    values = {name: number(value, name, where) for name, value in zip(names, parameters, strict=True)}
    fx, fy = (values.get(name, values.get("f", 0.0)) for name in ("fx", "fy"))
    lens_model = COLMAP_MODELS[model][2]
    lens = [value for name, value in values.items() if name[0] in "kp"]
    lens += [0.0] * (_DISTORTION_ORDER.get(lens_model, 0) - len(lens))
    distortion = (lens_model, tuple(lens)) if any(lens) else ("", ())
    # The centre of COLMAP's top-left pixel is (0.5, 0.5).
    return CameraValues(fx, fy, values["cx"] - 0.5, values["cy"] - 0.5, size, None, *distortion)
