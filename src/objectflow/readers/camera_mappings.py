"""Camera files of named values (JSON or YAML), recognised by their keys.

| keys | written by |
|---|---|
| `width height fx fy cx cy`, optionally `depth_scale` | objectflow; BOP, whose `depth_scale` is millimetres per unit |
| `image_width camera_matrix ...`, or `width K D` | ROS camera calibration, `ros2 topic echo` of CameraInfo |
| `intrinsic_matrix` | Open3D |
| `ppx ppy` | RealSense |
| `cam_K` | BOP scenes |
| `K` with `w h` | Record3D |
| `fl_x fl_y cx cy w h` | instant-ngp and nerfstudio |
| `Camera.fx ...`, optionally `DepthMapFactor` | ORB-SLAM |
| one of these under `camera`, `color`, `rgb`, `intrinsics`, ... | Replica, RealSense and others |
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from types import SimpleNamespace
from typing import Any

from objectflow.errors import CameraError
from objectflow.geometry.camera import check_depth_scale
from objectflow.readers.camera_info import binned, crop_and_bin
from objectflow.readers.camera_values import CameraValues, from_matrix, number

NESTED = ("camera", "color", "rgb", "color_intrinsics", "rgb_intrinsics", "color_camera", "intrinsics", "intrinsic")
"""Keys below which a camera is looked for, in order."""
_MAX_NESTING = 3


def from_mapping(values: Mapping[str, Any], where: str) -> CameraValues:
    """The camera of a mapping, by the first known set of keys.

    Args:
        values: content of a JSON or YAML file.
        where: start of messages.

    Raises:
        CameraError: a value is missing or invalid.
        FrameError: a depth scale that is no positive number.
    """
    return _find(values, where, 0) or _plain(values, where)


def _find(values: Mapping[str, Any], where: str, depth: int) -> CameraValues | None:
    for key, read in _READERS.items():
        if key in values:
            return read(values, where)
    if values and all(key.isdigit() and isinstance(value, dict) and "cam_K" in value for key, value in values.items()):
        return _one_of_many(values, where)
    if {"fx", "fy"} & set(values) or depth == _MAX_NESTING:
        return _plain(values, where) if "fx" in values and "fy" in values else None
    for key in NESTED:
        inner = values.get(key)
        found = _find(inner, f"{where}: {key}", depth + 1) if isinstance(inner, dict) else None
        if found is not None:
            return found
    return None


def _plain(values: Mapping[str, Any], where: str) -> CameraValues:
    names = ("width", "height", "fx", "fy", "cx", "cy")
    given = {**values, **{long: values[short] for long, short in (("width", "w"), ("height", "h")) if short in values}}
    missing = [name for name in names if name not in given]
    if missing:
        raise CameraError(f"{where}: {', '.join(missing)} missing")
    scale, note = given.get("depth_scale", given.get("scale")), ""
    if scale is not None:
        check_depth_scale(scale, where=f"{where}: ")
        if scale <= 1:
            scale, note = 1000 / scale, f"{where}: depth_scale {scale:g} is millimetres per unit, as in BOP data sets"
    fx, fy, cx, cy = (number(given[name], name, where) for name in ("fx", "fy", "cx", "cy"))
    return CameraValues(fx, fy, cx, cy, _size(given, "width", "height", where), _float(scale), note=note)


def _one_of_many(values: Mapping[str, Any], where: str) -> CameraValues:
    cameras = {_bop(value, f"{where}: image {key}") for key, value in values.items()}
    if len(cameras) > 1:
        raise CameraError(f"{where}: the images have {len(cameras)} different cameras: one camera is needed")
    return cameras.pop()


def _bop(values: Mapping[str, Any], where: str) -> CameraValues:
    scale = values.get("depth_scale")
    if scale is not None:
        check_depth_scale(scale, where=f"{where}: ")
    # Depth of BOP is value * depth_scale millimetres.
    return CameraValues(*from_matrix(values["cam_K"], where), depth_scale=None if scale is None else 1000 / scale)


def _open3d(values: Mapping[str, Any], where: str) -> CameraValues:
    intrinsics = from_matrix(values["intrinsic_matrix"], where)
    scale = values.get("depth_scale")
    if scale is not None:
        check_depth_scale(scale, where=f"{where}: ")
    size = _size(values, "width", "height", where) if "width" in values else None
    return CameraValues(*intrinsics, size=size, depth_scale=_float(scale))


def _realsense(values: Mapping[str, Any], where: str) -> CameraValues:
    missing = [name for name in ("fx", "fy", "ppx", "ppy") if name not in values]
    if missing:
        raise CameraError(f"{where}: {', '.join(missing)} missing")
    fx, fy, cx, cy = (number(values[name], name, where) for name in ("fx", "fy", "ppx", "ppy"))
    scale = values.get("depth_scale", values.get("depth_units"))
    if scale is not None:
        check_depth_scale(scale, where=f"{where}: ")
        # The driver's scale is metres per unit, such as 0.001 or 0.00025.
        scale = 1 / scale if scale < 1 else scale
    size = _size(values, "width", "height", where) if "width" in values else None
    model = str(values.get("model", values.get("distortion_model", "")))
    coefficients = _numbers(values.get("coeffs", values.get("distortion", ())), "coeffs", where)
    return CameraValues(fx, fy, cx, cy, size, _float(scale), *_lens(model, coefficients))


def _ros_yaml(values: Mapping[str, Any], where: str) -> CameraValues:
    matrix = values["camera_matrix"]
    intrinsics = from_matrix(matrix.get("data") if isinstance(matrix, dict) else matrix, where)
    lens = values.get("distortion_coefficients", {})
    coefficients = _numbers(lens.get("data", ()) if isinstance(lens, dict) else lens, "distortion_coefficients", where)
    model = str(values.get("distortion_model", values.get("camera_model", "plumb_bob")))
    size = _size(values, "image_width", "image_height", where) if "image_width" in values else None
    return CameraValues(*intrinsics, size, None, *_lens(model, coefficients))


def _ros_message(values: Mapping[str, Any], where: str) -> CameraValues:
    """A CameraInfo message as text; Record3D's `metadata` has the same key `K`, and w and h in place of width."""
    intrinsics = from_matrix(values.get("K", values.get("k")), where)
    names = ("w", "h") if "w" in values else ("width", "height")
    size = _size(values, *names, where) if names[0] in values else None
    coefficients = _numbers(values.get("D", values.get("d", ())), "D", where)
    lens = _lens(str(values.get("distortion_model", "")), coefficients)
    return _region_of_interest(CameraValues(*intrinsics, size, None, *lens), values, where)


def _region_of_interest(sensor: CameraValues, values: Mapping[str, Any], where: str) -> CameraValues:
    """The camera of the binned region of interest that a CameraInfo message describes."""
    region = values.get("roi") or {}
    if sensor.size is None or not isinstance(region, dict):
        return sensor
    names = ("x_offset", "y_offset", "width", "height")
    roi = {name: int(number(region.get(name, 0), f"roi.{name}", where)) for name in names}
    binning_x, binning_y = (max(1, int(number(values.get(f"binning_{a}", 0), f"binning_{a}", where))) for a in "xy")
    if not any(roi.values()) and (binning_x, binning_y) == (1, 1):
        return sensor
    width, height = sensor.size
    message = SimpleNamespace(
        width=width, height=height, binning_x=binning_x, binning_y=binning_y, roi=SimpleNamespace(**roi)
    )
    size = binned((roi["width"] or width, roi["height"] or height), (binning_x, binning_y))
    (x_bins, y_bins), (x, y), notes = crop_and_bin(message, size, (sensor.cx, sensor.cy), where)
    return dataclasses.replace(
        sensor,
        fx=sensor.fx / x_bins,
        fy=sensor.fy / y_bins,
        cx=(sensor.cx - x) / x_bins,
        cy=(sensor.cy - y) / y_bins,
        size=size,
        note="; ".join(notes),
    )


def _nerf(values: Mapping[str, Any], where: str) -> CameraValues:
    given = {**values, "fx": values["fl_x"], "fy": values.get("fl_y", values["fl_x"])}
    plain = _plain({key: value for key, value in given.items() if key not in ("scale", "depth_scale")}, where)
    names = ("k1", "k2", "p1", "p2", "k3")
    lens = _lens("plumb_bob", tuple(number(values.get(name, 0), name, where) for name in names))
    # Pixel centres of this format lie at half numbers.
    return CameraValues(plain.fx, plain.fy, plain.cx - 0.5, plain.cy - 0.5, plain.size, None, *lens)


def _orb_slam(prefix: str) -> Callable[[Mapping[str, Any], str], CameraValues]:
    def read(values: Mapping[str, Any], where: str) -> CameraValues:
        names = ("fx", "fy", "cx", "cy")
        missing = [f"{prefix}.{name}" for name in names if f"{prefix}.{name}" not in values]
        if missing:
            raise CameraError(f"{where}: {', '.join(missing)} missing")
        fx, fy, cx, cy = (number(values[f"{prefix}.{name}"], name, where) for name in names)
        size = _size(values, "Camera.width", "Camera.height", where) if "Camera.width" in values else None
        scale = values.get("DepthMapFactor", values.get("RGBD.DepthMapFactor"))
        if scale is not None:
            check_depth_scale(scale, where=f"{where}: ")
            scale = 1 / scale if scale < 1 else scale
        order = ("k1", "k2", "p1", "p2", "k3")
        lens = tuple(number(values.get(f"{prefix}.{name}", 0), name, where) for name in order)
        return CameraValues(fx, fy, cx, cy, size, _float(scale), *_lens("plumb_bob", lens))

    return read


_READERS: dict[str, Callable[[Mapping[str, Any], str], CameraValues]] = {
    "intrinsic_matrix": _open3d,
    "ppx": _realsense,
    "ppy": _realsense,
    "camera_matrix": _ros_yaml,
    "cam_K": _bop,
    "fl_x": _nerf,
    "Camera.fx": _orb_slam("Camera"),
    "Camera1.fx": _orb_slam("Camera1"),
    "K": _ros_message,
    "k": _ros_message,
}


def _size(values: Mapping[str, Any], width: str, height: str, where: str) -> tuple[int, int]:
    if width not in values or height not in values:
        raise CameraError(f"{where}: {width if width not in values else height} missing")
    found = (number(values[width], width, where), number(values[height], height, where))
    if any(value != int(value) or value < 1 for value in found):
        raise CameraError(f"{where}: camera size must be whole and positive, not {found[0]:g}x{found[1]:g}")
    return int(found[0]), int(found[1])


def _lens(model: str, coefficients: tuple[float, ...]) -> tuple[str, tuple[float, ...]]:
    return (model, coefficients) if any(coefficients) else ("", ())


def _numbers(values: Any, name: str, where: str) -> tuple[float, ...]:
    if not isinstance(values, (list, tuple)):
        raise CameraError(f"{where}: {name} must be a list of numbers")
    return tuple(number(value, name, where) for value in values)


def _float(value: Any) -> float | None:
    return None if value is None else float(value)
