"""Camera files in every form, with the values that the writing programs define."""

from __future__ import annotations

import json
import os
import struct
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from objectflow import geometry
from objectflow.errors import CameraError, ObjectflowError, ReaderError
from objectflow.geometry.camera import Camera
from objectflow.readers import CameraOptions
from objectflow.readers.camera_files import read_camera_file

FX, FY, CX, CY = 525.5, 526.0, 319.5, 239.25
ROW = [FX, 0, CX, 0, FY, CY, 0, 0, 1]
COLUMN = [FX, 0, 0, 0, FY, 0, CX, CY, 1]
OURS = {"width": 640, "height": 480, "fx": FX, "fy": FY, "cx": CX, "cy": CY}
ROS_YAML = f"""\
image_width: 640
image_height: 480
camera_name: head_camera
camera_matrix:
  rows: 3
  cols: 3
  data: {ROW}
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [0, 0, 0, 0, 0]
rectification_matrix:
  rows: 3
  cols: 3
  data: [1, 0, 0, 0, 1, 0, 0, 0, 1]
projection_matrix:
  rows: 3
  cols: 4
  data: [{FX}, 0, {CX}, 0, 0, {FY}, {CY}, 0, 0, 0, 1, 0]
"""
ROS_ECHO = f"""\
header:
  stamp: {{sec: 1, nanosec: 2}}
  frame_id: camera_color_optical_frame
height: 480
width: 640
distortion_model: plumb_bob
d: [0.0, 0.0, 0.0, 0.0, 0.0]
k: {ROW}
r: [1, 0, 0, 0, 1, 0, 0, 0, 1]
p: [{FX}, 0, {CX}, 0, 0, {FY}, {CY}, 0, 0, 0, 1, 0]
binning_x: 0
---
"""
ORB_SLAM = f"""\
%YAML:1.0
# Camera calibration and distortion parameters (OpenCV)
Camera.fx: {FX}
Camera.fy: {FY}
Camera.cx: {CX}
Camera.cy: {CY}
Camera.k1: 0.0
Camera.width: 640
Camera.height: 480
DepthMapFactor: 5000.0
"""
COLMAP = f"""\
# Camera list with one line of data per camera:
#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]
1 PINHOLE 640 480 {FX} {FY} {CX + 0.5} {CY + 0.5}
"""
REALSENSE = {
    "width": 640,
    "height": 480,
    "fx": FX,
    "fy": FY,
    "ppx": CX,
    "ppy": CY,
    "model": "distortion.inverse_brown_conrady",
    "coeffs": [0.0, 0.0, 0.0, 0.0, 0.0],
}
TEXTS: dict[str, tuple[str, str]] = {
    "ours": ("camera.json", json.dumps(OURS)),
    "ours with a mark": ("camera.json", "\ufeff" + json.dumps(OURS)),
    "ros yaml": ("camera_info.yaml", ROS_YAML),
    "ros echo": ("camera_info.yml", ROS_ECHO),
    "ros 1 message": ("info.json", json.dumps({"width": 640, "height": 480, "D": [], "K": ROW})),
    "open3d": ("camera_intrinsic.json", json.dumps({"width": 640, "height": 480, "intrinsic_matrix": COLUMN})),
    "open3d view": ("v.json", json.dumps({"intrinsic": {"width": 640, "height": 480, "intrinsic_matrix": COLUMN}})),
    "realsense": ("rs.json", json.dumps(REALSENSE)),
    "realsense nested": ("rs.json", json.dumps({"depth": {**REALSENSE, "fx": 1.0}, "color": REALSENSE})),
    "matrix": ("K.txt", f"{FX} 0 {CX}\n0 {FY} {CY}\n0 0 1\n"),
    "matrix of numpy": ("K.txt", "\n".join(" ".join(f"{v:.18e}" for v in ROW[i : i + 3]) for i in (0, 3, 6))),
    "matrix as a list": ("K.txt", f"[[{FX}, 0.0, {CX}],\n [0.0, {FY}, {CY}],\n [0.0, 0.0, 1.0]]"),
    "matrix of 4x4": ("intrinsic_color.txt", f"{FX} 0 {CX} 0\n0 {FY} {CY} 0\n0 0 1 0\n0 0 0 1\n"),
    "four numbers": ("calibration.txt", f"{FX} {FY} {CX} {CY}"),
    "four numbers with commas": ("K.txt", f"# fx, fy, cx, cy\r\n{FX}, {FY}, {CX}, {CY}\r\n"),
    "colmap": ("cameras.txt", COLMAP),
    "bop": ("camera.json", json.dumps({**OURS, "depth_scale": 0.1})),
    "bop scene": ("scene_camera.json", json.dumps({str(k): {"cam_K": ROW, "depth_scale": 0.1} for k in range(3)})),
    "record3d": ("metadata", json.dumps({"w": 640, "h": 480, "fps": 60, "K": COLUMN})),
    "replica": ("cam_params.json", json.dumps({"camera": {**OURS, "w": 640, "h": 480, "scale": 6553.5}})),
    "orb-slam": ("TUM1.yaml", ORB_SLAM),
    "nerf": ("t.json", json.dumps({"w": 640, "h": 480, "fl_x": FX, "fl_y": FY, "cx": CX + 0.5, "cy": CY + 0.5})),
}
SCALES = {"bop": 10000, "bop scene": 10000, "replica": 6553.5, "orb-slam": 5000}


@pytest.mark.parametrize("form", TEXTS)
def test_every_form_gives_the_same_camera(tmp_path: Path, form: str) -> None:
    name, text = TEXTS[form]
    (tmp_path / name).write_text(text, encoding="utf-8", newline="")
    values = read_camera_file(tmp_path / name)
    np.testing.assert_allclose([values.fx, values.fy, values.cx, values.cy], [FX, FY, CX, CY], rtol=1e-12)
    assert values.size in (None, (640, 480))
    assert values.depth_scale == pytest.approx(SCALES[form]) if form in SCALES else values.depth_scale is None
    assert values.distortion == ()
    setup = CameraOptions(camera_file=tmp_path / name).fit((640, 480), tmp_path)
    assert (setup.camera.width, setup.camera.height, setup.camera.fx) == (640, 480, FX)


def test_a_ros_message_of_a_binned_region_of_interest(tmp_path: Path) -> None:
    """A point that projects into the region lies at the same place of the image that the region was binned to."""
    message: dict[str, Any] = {"width": 640, "height": 480, "D": [], "K": ROW}
    message |= {"binning_x": 2, "binning_y": 2}
    message["roi"] = {"x_offset": 100, "y_offset": 60, "width": 400, "height": 300, "do_rectify": False}
    (tmp_path / "info.json").write_text(json.dumps(message))
    values = read_camera_file(tmp_path / "info.json")
    assert values.size == (200, 150)
    setup = CameraOptions(camera_file=tmp_path / "info.json").fit((200, 150), tmp_path)
    point = np.array([0.1, -0.05, 1.3])
    on_sensor = geometry.project(point, Camera(width=640, height=480, fx=FX, fy=FY, cx=CX, cy=CY))
    np.testing.assert_allclose(geometry.project(point, setup.camera), (on_sensor - [100, 60]) / 2, rtol=1e-12)
    # Zeros mean the full sensor, unbinned.
    message |= {"binning_x": 0, "binning_y": 0, "roi": dict.fromkeys(message["roi"], 0)}
    (tmp_path / "info.json").write_text(json.dumps(message))
    values = read_camera_file(tmp_path / "info.json")
    assert (values.size, values.fx, values.cx) == ((640, 480), FX, CX)


def test_a_matrix_of_numpy_and_a_binary_model_of_colmap(tmp_path: Path) -> None:
    np.save(tmp_path / "K.npy", np.array(ROW).reshape(3, 3))
    assert read_camera_file(tmp_path / "K.npy").fx == FX
    data = struct.pack("<QiiQQ4d", 1, 1, 1, 640, 480, FX, FY, CX + 0.5, CY + 0.5)
    (tmp_path / "cameras.bin").write_bytes(data)
    values = read_camera_file(tmp_path / "cameras.bin")
    assert (values.size, values.fy, values.cx) == ((640, 480), FY, CX)


@pytest.mark.parametrize(
    ("name", "text", "model", "coefficients"),
    [
        ("a.yaml", ROS_YAML.replace("[0, 0, 0, 0, 0]", "[0.1, -0.2, 0.001, 0, 0.05]"), "plumb_bob", 5),
        ("a.json", json.dumps({**REALSENSE, "coeffs": [0.1, 0, 0, 0, 0]}), "distortion.inverse_brown_conrady", 5),
        ("cameras.txt", f"1 OPENCV 640 480 {FX} {FY} {CX} {CY} 0.1 -0.2 0.001 0.002", "plumb_bob", 4),
        ("cameras.txt", f"1 SIMPLE_RADIAL 640 480 {FX} {CX} {CY} 0.1", "plumb_bob", 4),
        ("cameras.txt", f"1 OPENCV_FISHEYE 640 480 {FX} {FY} {CX} {CY} 0.1 0 0 0", "equidistant", 4),
    ],
)
def test_distortion_is_kept(tmp_path: Path, name: str, text: str, model: str, coefficients: int) -> None:
    (tmp_path / name).write_text(text)
    values = read_camera_file(tmp_path / name)
    assert values.distortion_model == model
    assert values.distortion[0] == 0.1
    assert len(values.distortion) == coefficients


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("camera.json", json.dumps({k: v for k, v in OURS.items() if k != "cy"}), "cy missing"),
        ("camera.json", json.dumps({**OURS, "fy": -480}), r"--intrinsics 525.5 480 319.5 239.25"),
        ("K.txt", f"{FX} 0 {CX}\n0 -{FY} {CY}\n0 0 1\n", "negative focal length"),
        ("K.txt", f"{FX} 3 {CX}\n0 {FY} {CY}\n0 0 1\n", "without skew"),
        ("K.txt", "525 525 319.5", "not 3 numbers"),
        ("K.txt", "nan 525 319.5 239.5", "fx must be a finite number"),
        ("a.yaml", "image_width: 640\ncamera_matrix: {data: [1, 2]}\n", "3x3"),
        ("a.yaml", "a: [b", "not a camera file"),
        ("a.yaml", "a: " + "[" * 5000, "not a camera file"),
        ("K.txt", "[[]]", "not 0 numbers"),
        ("a.yaml", "just some words", "expected a JSON object"),
        ("rs.json", json.dumps({k: v for k, v in REALSENSE.items() if k != "ppy"}), "ppy missing"),
        ("o.json", json.dumps({"intrinsic_matrix": "x"}), "numbers"),
        ("scene_camera.json", json.dumps({"0": {"cam_K": ROW}, "1": {"cam_K": [1, *ROW[1:]]}}), "2 different cameras"),
        ("cameras.txt", COLMAP + "2 PINHOLE 640 480 1 1 1 1\n", "2 cameras"),
        ("cameras.txt", "1 PINHOLE 640 480 500 500", "4 parameters, this has 2"),
        ("cameras.bin", "short", "not a COLMAP"),
        ("K.npy", "\x93NUMPY", "not a camera file"),
    ],
)
def test_wrong_files_are_refused_in_one_line(tmp_path: Path, name: str, text: str, words: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises((CameraError, ReaderError), match=words) as caught:
        CameraOptions(camera_file=tmp_path / name).fit((640, 480), tmp_path)
    assert name in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("value", [None, True, "x", [], {}, 10**400, float("nan"), -1, 0, 1e308])
@pytest.mark.parametrize("form", ["ours", "realsense", "open3d", "ros 1 message", "bop", "bop scene", "nerf"])
def test_odd_values_raise_no_foreign_error(tmp_path: Path, form: str, value: Any) -> None:
    name, text = TEXTS[form]
    content = json.loads(text)
    for key in content:
        (tmp_path / name).write_text(json.dumps({**content, key: value}))
        with suppress(ObjectflowError):
            CameraOptions(camera_file=tmp_path / name).fit((640, 480), tmp_path)


def test_negative_intrinsics_on_the_command_line_are_refused_with_the_remedy(tmp_path: Path) -> None:
    with pytest.raises(CameraError, match=r"--intrinsics 481.2 480 319.5 239.5"):
        CameraOptions(intrinsics=(481.2, -480.0, 319.5, 239.5)).fit((640, 480), tmp_path)


def test_a_pipe_is_no_camera_file(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "camera.json")
    with pytest.raises(ReaderError, match="regular file"):
        CameraOptions(camera_file=tmp_path / "camera.json").fit((640, 480), tmp_path)
