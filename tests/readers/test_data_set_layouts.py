"""Layouts of public data sets and recorders: frames, cameras, units and notes."""

from __future__ import annotations

import json
import sys
import zipfile
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import cv2
import lzfse
import numpy as np
import pytest
import tifffile
from numpy.typing import NDArray

from helpers.layout_files import CAMERA, HEIGHT, WIDTH, K, check_frames, color, depth, write, write_frames
from objectflow.errors import CameraError, MissingExtraError, ReaderError
from objectflow.geometry.camera import Camera
from objectflow.readers import open_source

# --- data sets ---


def test_bop_scenes_have_their_camera_and_scale(tmp_path: Path) -> None:
    write_frames(tmp_path, "rgb/{:06d}.png", "depth/{:06d}.png", units=10000)
    cameras = {str(k): {"cam_K": K, "depth_scale": 0.1} for k in range(4)}
    (tmp_path / "scene_camera.json").write_text(json.dumps(cameras))
    source = open_source(tmp_path)
    check_frames(source)
    assert source.camera == Camera(**CAMERA)  # type: ignore[arg-type]
    cameras["2"]["cam_K"] = [31.0, *K[1:]]
    (tmp_path / "scene_camera.json").write_text(json.dumps(cameras))
    with pytest.raises(CameraError, match="2 different cameras"):
        open_source(tmp_path)


def test_scannet_colour_is_brought_to_the_pixels_of_depth(tmp_path: Path) -> None:
    """A ramp of colour over the angle of view: each depth pixel must see the colour of its own ray."""
    color_k = (80.0, 80.0, 47.5, 35.5)
    u = np.arange(96)
    angle = (u - color_k[2]) / color_k[0]
    ramp = np.broadcast_to((128 + 150 * angle)[None, :, None], (72, 96, 3)).round().astype(np.uint8)
    for k in range(2):
        write(tmp_path / f"color/{k}.png", ramp)
        write(tmp_path / f"depth/{k}.png", depth(1000))
    (tmp_path / "intrinsic").mkdir()
    for name, (fx, fy, cx, cy) in (("color", color_k), ("depth", (30.0, 31.0, 15.5, 11.5))):
        matrix = np.array([[fx, 0, cx, 0], [0, fy, cy, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
        np.savetxt(tmp_path / "intrinsic" / f"intrinsic_{name}.txt", matrix)
    source = open_source(tmp_path)
    frame = source[0]
    assert source.camera == Camera(**CAMERA)  # type: ignore[arg-type]
    expected = 128 + 150 * (np.arange(WIDTH) - 15.5) / 30.0
    np.testing.assert_allclose(frame.color[12, 2:-2, 0], expected[2:-2], atol=1.5)
    assert "ScanNet" in source.notes[0]


def test_seven_scenes_has_a_default_camera(tmp_path: Path) -> None:
    for k in range(2):
        write(tmp_path / f"frame-{k:06d}.color.png", color(k, 640, 480))
        image = depth(1000, 640, 480)
        image[:4] = 65535
        write(tmp_path / f"frame-{k:06d}.depth.png", image)
        np.savetxt(tmp_path / f"frame-{k:06d}.pose.txt", np.eye(4))
    source = open_source(tmp_path)
    assert (source.camera.fx, source.camera.cx) == (585, 320)
    assert (source[0].depth[:4] == 0).all()
    assert "7-Scenes" in source.notes[0]
    (tmp_path / "info.txt").write_text(
        "m_versionNumber = 4\nm_colorWidth = 640\nm_colorHeight = 480\nm_depthShift = 1000\n"
        "m_calibrationColorIntrinsic = 582.8 0 320 0 0 582.7 240 0 0 0 1 0 0 0 0 1\n"
    )
    assert open_source(tmp_path).camera.fy == 582.7


def test_replica_reads_its_parameters(tmp_path: Path) -> None:
    folder = tmp_path / "room0"
    write_frames(folder, "results/frame{:06d}.jpg", "results/depth{:06d}.png", units=6554)
    (folder / "traj.txt").write_text("")
    camera = {"w": WIDTH, "h": HEIGHT, "fx": 30.0, "fy": 31.0, "cx": 15.5, "cy": 11.5, "scale": 6553.5}
    (tmp_path / "cam_params.json").write_text(json.dumps({"camera": camera}))
    source = open_source(folder)
    check_frames(source)
    assert source.depth_scale == 6553.5
    assert source.camera == Camera(**CAMERA)  # type: ignore[arg-type]


def test_kubric_ray_lengths_become_planar_depth(tmp_path: Path) -> None:
    """A wall at 2 m: the distance along the rays grows towards the corners."""
    focal = 35.0 / 32.0 * WIDTH
    x, y = (np.arange(WIDTH) - (WIDTH - 1) / 2) / focal, (np.arange(HEIGHT) - (HEIGHT - 1) / 2) / focal
    lengths = 2 * np.sqrt(1 + x[None] ** 2 + y[:, None] ** 2)
    for k in range(2):
        write(tmp_path / f"rgba_{k:05d}.png", np.dstack([color(k), np.full((HEIGHT, WIDTH), 255, np.uint8)]))
        tifffile.imwrite(tmp_path / f"depth_{k:05d}.tiff", lengths.astype(np.float32)[..., None])
    camera = {"focal_length": 35.0, "sensor_width": 32.0, "field_of_view": 0.86}
    (tmp_path / "metadata.json").write_text(json.dumps({"camera": camera, "metadata": {"num_frames": 2}}))
    source = open_source(tmp_path)
    np.testing.assert_allclose(source[0].depth, 2, rtol=1e-6)
    assert source.camera.fx == pytest.approx(focal)
    assert "planar" in source.notes[0]


def test_captures_of_open3d_have_their_intrinsic(tmp_path: Path) -> None:
    write_frames(tmp_path, "color/{:06d}.jpg", "depth/{:06d}.png")
    column = [30.0, 0, 0, 0, 31.0, 0, 15.5, 11.5, 1]
    (tmp_path / "camera_intrinsic.json").write_text(
        json.dumps({"width": WIDTH, "height": HEIGHT, "intrinsic_matrix": column})
    )
    source = open_source(tmp_path)
    check_frames(source)
    assert source.camera == Camera(**CAMERA)  # type: ignore[arg-type]


RECORD3D = {"w": WIDTH, "h": HEIGHT, "dw": 16, "dh": 12, "fps": 60, "K": [30.0, 0, 0, 0, 31.0, 0, 15.5, 11.5, 1]}


def test_an_exported_folder_of_record3d(tmp_path: Path) -> None:
    import OpenEXR

    for k in range(2):
        write(tmp_path / f"rgb/{k}.png", color(k))
        header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
        metres = np.full((12, 16), 1.5, np.float32)
        metres[0, 0] = np.nan
        (tmp_path / "depth").mkdir(exist_ok=True)
        OpenEXR.File(header, {"R": metres}).write(str(tmp_path / f"depth/{k}.exr"))
    (tmp_path / "metadata.json").write_text(json.dumps(RECORD3D))
    source = open_source(tmp_path)
    assert source.camera == Camera(**CAMERA)  # type: ignore[arg-type]
    assert (source[0].depth[2:, 2:] == 1.5).all()
    assert (source[0].depth[:2, :2] == 0).all()


def write_r3d(path: Path, depths: list[NDArray[np.float32]], **changes: Any) -> None:
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("metadata", json.dumps({**RECORD3D, **changes}))
        for k, metres in enumerate(depths):
            archive.writestr(f"rgbd/{k}.jpg", cv2.imencode(".jpg", color(10 * k))[1].tobytes())
            archive.writestr(f"rgbd/{k}.depth", lzfse.compress(metres.tobytes()))


def test_an_r3d_file(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    depths = [rng.uniform(1, 2, (12, 16)).astype(np.float32), np.full((12, 16), 1.5, np.float32)]
    write_r3d(tmp_path / "a.r3d", depths, frameTimestamps=[5.0, 5.1])
    source = open_source(tmp_path / "a.r3d")
    assert source.camera == Camera(**CAMERA)  # type: ignore[arg-type]
    for frame, metres in zip(source, depths, strict=True):
        np.testing.assert_array_equal(frame.depth, np.kron(metres, np.ones((2, 2))).astype(np.float32))
    assert [source.timestamp(k) for k in range(2)] == [5.0, 5.1]
    assert abs(int(source[1].color[0, 0, 0]) - 10) <= 2


def test_an_r3d_file_that_unpacks_to_too_much_is_refused(tmp_path: Path) -> None:
    write_r3d(tmp_path / "a.r3d", [np.zeros((1000, 1000), np.float32)] * 2)
    with pytest.raises(ReaderError, match="depth has 4000000 bytes, not 16x12"):
        open_source(tmp_path / "a.r3d")[0]
    (tmp_path / "b.r3d").write_bytes(b"PK\x03\x04")
    with pytest.raises(ReaderError, match=r"not an .r3d file"):
        open_source(tmp_path / "b.r3d")
    write_r3d(tmp_path / "c.r3d", [], K="x")
    with pytest.raises(ReaderError, match="0 frames with colour and depth"):
        open_source(tmp_path / "c.r3d")


def test_a_camera_file_with_distortion_undistorts_the_images(tmp_path: Path) -> None:
    """Colour is compared with OpenCV's own undistortion, depth with the nearest pixel of its map."""
    rng = np.random.default_rng(0)
    matrix, lens = np.array(K, float).reshape(3, 3), np.array([-0.2, 0.05, 0.001, -0.002, 0.0])
    image = cv2.GaussianBlur(rng.integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8), (0, 0), 2)
    units = rng.integers(900, 1100, (HEIGHT, WIDTH), dtype=np.uint16)
    for k in range(2):
        write(tmp_path / f"color/{k}.png", image)
        write(tmp_path / f"depth/{k}.png", units)
    (tmp_path / "camera_info.yaml").write_text(
        f"image_width: {WIDTH}\nimage_height: {HEIGHT}\ndistortion_model: plumb_bob\n"
        f"camera_matrix: {{rows: 3, cols: 3, data: {K}}}\n"
        f"distortion_coefficients: {{rows: 1, cols: 5, data: {lens.tolist()}}}\n"
    )
    source = open_source(tmp_path)
    frame = source[0]
    expected = cv2.undistort(image, matrix, lens)[..., ::-1]
    assert np.abs(frame.color.astype(int) - expected).max() <= 2
    map_u, map_v = cv2.initUndistortRectifyMap(matrix, lens, None, matrix, (WIDTH, HEIGHT), cv2.CV_32FC1)
    nearest = cv2.remap(units, map_u, map_v, cv2.INTER_NEAREST) / 1000
    assert (np.abs(frame.depth - nearest) < 1e-6).mean() > 0.98
    assert "colour and depth are undistorted" in source.notes[0]


# --- Azure Kinect ---


def test_an_azure_kinect_recording_without_the_library_says_how_to_convert(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pyk4a", None)
    (tmp_path / "a.mkv").write_bytes(b"\x1a\x45\xdf\xa3")
    with pytest.raises(MissingExtraError, match=r"azure_kinect_mkv_reader.py") as caught:
        open_source(tmp_path / "a.mkv")
    assert "\n" not in str(caught.value)


def test_an_azure_kinect_recording_by_its_library(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A stand-in for pyk4a: three captures, of which one has no depth."""
    jpeg = np.frombuffer(cv2.imencode(".jpg", color(50))[1].tobytes(), np.uint8)

    class Playback:
        def __init__(self, path: Path) -> None:
            self.at = 0
            self.calibration = SimpleNamespace(get_camera_matrix=lambda kind: np.array(K).reshape(3, 3))

        def open(self) -> None:
            pass

        def seek(self, microseconds: int) -> None:
            self.at = microseconds // 33333

        def get_next_capture(self) -> Any:
            if self.at == 3:
                raise EOFError
            k, self.at = self.at, self.at + 1
            bgra = np.dstack([color(10 + k), np.full((HEIGHT, WIDTH), 255, np.uint8)])
            present = k != 1
            return SimpleNamespace(
                color=bgra if k == 0 else jpeg,
                depth=depth(1) if present else None,
                transformed_depth=depth(1000 + k) if present else None,
                color_timestamp_usec=33333 * k,
            )

    module = ModuleType("pyk4a")
    module.PyK4APlayback = Playback  # type: ignore[attr-defined]
    module.CalibrationType = SimpleNamespace(COLOR=1)  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "pyk4a", module)
    (tmp_path / "a.mkv").write_bytes(b"\x1a\x45\xdf\xa3")
    source = open_source(tmp_path / "a.mkv")
    assert len(source) == 2
    assert source.notes == ("1 of 3 captures without colour or depth left out",)
    assert source.camera == Camera(**CAMERA)  # type: ignore[arg-type]
    np.testing.assert_allclose(source[1].depth, 1.002)
    assert source[0].color[0, 0, 0] == 10
    assert abs(int(source[1].color[0, 0, 0]) - 50) <= 2
    assert source.timestamp(1) == pytest.approx(0.066666)
