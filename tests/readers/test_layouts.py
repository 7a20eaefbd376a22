"""Folders in the layouts of public data sets and recorders: frames, cameras, units and notes."""

from __future__ import annotations

import json
import os
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

from objectflow.errors import CameraError, MissingExtraError, ReaderError
from objectflow.geometry.camera import Camera
from objectflow.readers import CameraOptions, open_source

WIDTH, HEIGHT = 32, 24
CAMERA = {"width": WIDTH, "height": HEIGHT, "fx": 30.0, "fy": 31.0, "cx": 15.5, "cy": 11.5}
K = [30.0, 0, 15.5, 0, 31.0, 11.5, 0, 0, 1]
OPTIONS = CameraOptions(intrinsics=(30.0, 31.0, 15.5, 11.5))


def write(path: Path, image: NDArray[Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), image)


def color(value: int, width: int = WIDTH, height: int = HEIGHT) -> NDArray[np.uint8]:
    return np.full((height, width, 3), value, np.uint8)


def depth(value: int, width: int = WIDTH, height: int = HEIGHT) -> NDArray[np.uint16]:
    return np.full((height, width), value, np.uint16)


def write_frames(folder: Path, color_name: str, depth_name: str, count: int = 4, units: int = 1000) -> None:
    """Frame k has colour 10 + k and a depth of 1 + k / 10 metres."""
    for k in range(count):
        write(folder / color_name.format(k), color(10 + k))
        write(folder / depth_name.format(k), depth(round(units * (1 + k / 10))))


def check_frames(source: Any, count: int = 4) -> None:
    assert len(source) == count
    for k, frame in enumerate(source):
        assert frame.color[3, 4].tolist() == [10 + k] * 3
        np.testing.assert_allclose(frame.depth, 1 + k / 10, atol=1e-3)


# --- TUM ---


def write_tum(folder: Path, lines: dict[str, str], units: int = 5000, encoding: str = "utf-8") -> None:
    write_frames(folder, "rgb/{}.png", "depth/{}.png", units=units)
    for name, text in lines.items():
        (folder / name).write_bytes(text.encode(encoding))


@pytest.mark.parametrize(
    ("form", "encoding"),
    [
        ("# a comment\n{t:.6f} {f}\n", "utf-8"),
        ("{t:.6f} {f}\r\n", "utf-8-sig"),
        ("{t:.6f},{f}\n", "utf-8"),
        ("{t:.6f}, {f}\r\n", "utf-16"),
        ("{t:.6f}\t./{f}\n", "utf-8"),
    ],
)
def test_lists_as_editors_and_spreadsheets_write_them(tmp_path: Path, form: str, encoding: str) -> None:
    lists = {
        f"{kind}.txt": "".join(form.format(t=100 + 0.3 * k, f=f"{kind}/{k}.png") for k in range(4))
        for kind in ("rgb", "depth")
    }
    write_tum(tmp_path, lists, encoding=encoding)
    source = open_source(tmp_path, OPTIONS)
    check_frames(source)
    assert [source.timestamp(k) for k in range(4)] == pytest.approx([100, 100.3, 100.6, 100.9])
    assert source.notes == ()


@pytest.mark.parametrize("per_second", [10**3, 10**6, 10**9])
def test_whole_stamps_in_smaller_units(tmp_path: Path, per_second: int) -> None:
    start = 1403636579
    lists = {
        f"{kind}.txt": "".join(f"{start * per_second + k * per_second // 10} {kind}/{k}.png\n" for k in range(4))
        for kind in ("rgb", "depth")
    }
    write_tum(tmp_path, lists)
    source = open_source(tmp_path, OPTIONS)
    check_frames(source)
    assert source.timestamp(3) == pytest.approx(start + 0.3, abs=1e-3)
    assert any("not in seconds" in note for note in source.notes)


def test_no_pair_crosses_a_clock_that_was_set_back(tmp_path: Path) -> None:
    write_frames(tmp_path, "rgb/{}.png", "depth/{}.png", count=12, units=5000)
    stamps = [200 + 0.1 * k for k in range(6)] + [50 + 0.1 * k for k in range(6)]
    for kind in ("rgb", "depth"):
        text = "".join(f"{stamp:.3f} {kind}/{k}.png\n" for k, stamp in enumerate(stamps))
        (tmp_path / f"{kind}.txt").write_text(text)
    source = open_source(tmp_path, OPTIONS)
    check_frames(source, 12)
    assert source.cuts == (6,)
    assert any("goes back" in note for note in source.notes)


def test_an_unordered_list_is_sorted(tmp_path: Path) -> None:
    order = [3, 0, 2, 1]
    lists = {
        f"{kind}.txt": "".join(f"{100 + 0.1 * k:.1f} {kind}/{k}.png\n" for k in order) for kind in ("rgb", "depth")
    }
    write_tum(tmp_path, lists)
    check_frames(open_source(tmp_path, OPTIONS))


def test_depth_that_lags_is_paired_with_max_lag(tmp_path: Path) -> None:
    lists = {
        "rgb.txt": "".join(f"{100 + 0.1 * k:.3f} rgb/{k}.png\n" for k in range(4)),
        "depth.txt": "".join(f"{100.035 + 0.1 * k:.3f} depth/{k}.png\n" for k in range(4)),
    }
    write_tum(tmp_path, lists)
    with pytest.raises(ReaderError, match=r"within 0.02 s.*--max-lag 0.04 admits it"):
        open_source(tmp_path, OPTIONS)
    check_frames(open_source(tmp_path, CameraOptions(intrinsics=OPTIONS.intrinsics, max_lag=0.04)))


@pytest.mark.parametrize("line", ["{t} depth/{k}.png {t} rgb/{k}.png", "{t},rgb/{k}.png,{t},depth/{k}.png"])
@pytest.mark.parametrize("times", [[0, 1, 2, 3], [100.1, 100.2, 100.3, 100.4]])
def test_associations_name_colour_and_depth_in_either_order(tmp_path: Path, line: str, times: list[float]) -> None:
    lines = "\n".join(line.format(t=t, k=k) for k, t in enumerate(times))
    write_tum(tmp_path, {"associations.txt": lines})
    source = open_source(tmp_path, OPTIONS)
    check_frames(source)
    assert source.depth_scale == 5000
    assert "5000 depth units per metre" in " ".join(source.notes)
    # Frame numbers are no times.
    assert source.timestamp(1) == (None if times[0] == 0 else 100.2)


@pytest.mark.parametrize("name", ["../x.png", "/etc/hostname", "rgb/../../x.png", "..\\x.png"])
@pytest.mark.parametrize("layout", ["lists", "associations"])
def test_lists_stay_inside_their_folder(tmp_path: Path, name: str, layout: str) -> None:
    folder = tmp_path / "set"
    write(tmp_path / "x.png", color(1))
    lists = {"rgb.txt": f"1.0 rgb/0.png\n1.1 {name}\n", "depth.txt": "1.0 depth/0.png\n1.1 depth/1.png\n"}
    if layout == "associations":
        lists = {"associations.txt": f"1.0 rgb/0.png 1.0 depth/0.png\n1.1 {name} 1.1 depth/1.png\n"}
    write_tum(folder, lists)
    with pytest.raises(ReaderError, match=r"line 2: .* lies outside the folder"):
        open_source(folder, OPTIONS)


def test_missing_empty_and_special_files_are_named_and_left_in_place(tmp_path: Path) -> None:
    lists = {f"{kind}.txt": "".join(f"{100 + k} {kind}/{k}.png\n" for k in range(8)) for kind in ("rgb", "depth")}
    write_frames(tmp_path, "rgb/{}.png", "depth/{}.png", count=8, units=5000)
    for name, text in lists.items():
        (tmp_path / name).write_text(text)
    (tmp_path / "rgb/0.png").unlink()
    (tmp_path / "depth/2.png").write_bytes(b"")
    (tmp_path / "depth/4.png").unlink()
    os.mkfifo(tmp_path / "depth/4.png")
    (tmp_path / "depth/6.png").unlink()
    (tmp_path / "depth/6.png").symlink_to("/dev/zero")
    source = open_source(tmp_path, OPTIONS)
    assert len(source) == 8
    (note,) = source.notes
    assert note.startswith("4 of 8 frames cannot be read and are left out (")
    assert "rgb/0.png: no such file" in note
    for index in (0, 2, 4, 6):
        with pytest.raises(ReaderError):
            source[index]
    assert source[7].color[0, 0, 0] == 17


# --- numbered frames ---


def test_one_image_more_is_left_out_and_named(tmp_path: Path) -> None:
    write_frames(tmp_path, "color/{}.png", "depth/{}.png")
    write(tmp_path / "color" / "4.png", color(9))
    source = open_source(tmp_path, OPTIONS)
    check_frames(source)
    assert source.notes == ("1 colour image without a depth image left out: color/4.png",)


@pytest.mark.parametrize(
    ("color_name", "depth_name"),
    [
        ("rgb/frame_{:04d}_640x480.png", "depth/frame_{:04d}_640x480.png"),
        ("RGB/cam2_{:04d}_v3.png", "Depth/cam2_{:04d}_v3.png"),
        ("color/20240501_12000{}_7.png", "depth/20240501_12000{}_7.png"),
        ("color_1280x720_{:04d}.png", "depth_640x480_{:04d}.png"),
    ],
)
def test_names_with_sizes_and_several_numbers(tmp_path: Path, color_name: str, depth_name: str) -> None:
    write_frames(tmp_path, color_name, depth_name)
    check_frames(open_source(tmp_path, OPTIONS))


@pytest.mark.parametrize("stamp", ["13050311{:02d}.250000", "13050311{:02d}250000000", "13050311{:02d}_250000000"])
def test_stamps_in_names_give_times(tmp_path: Path, stamp: str) -> None:
    write_frames(tmp_path, f"rgb/{stamp}.png", f"depth/{stamp}.png")
    source = open_source(tmp_path, OPTIONS)
    check_frames(source)
    assert source.timestamp(2) == pytest.approx(1305031102.25)


def test_stamps_that_differ_are_paired_by_time(tmp_path: Path) -> None:
    for k in range(4):
        write(tmp_path / f"rgb/{1305031100 + 0.1 * k:.6f}.png", color(10 + k))
        write(tmp_path / f"depth/{1305031100.008 + 0.1 * k:.6f}.png", depth(1000 + 100 * k))
    source = open_source(tmp_path, OPTIONS)
    check_frames(source)
    assert source.timestamp(3) == pytest.approx(1305031100.3)


def test_depth_of_half_the_size_is_brought_to_colour(tmp_path: Path) -> None:
    for k in range(2):
        write(tmp_path / f"color/{k}.png", color(k))
        image = np.arange(12 * 16, dtype=np.uint16).reshape(12, 16) + 1000
        write(tmp_path / f"depth/{k}.png", image)
    source = open_source(tmp_path, OPTIONS)
    np.testing.assert_allclose(source[0].depth, np.kron(image, np.ones((2, 2))) / 1000, rtol=1e-6)
    assert "depth is 16x12, colour 32x24" in source.notes[0]
    for k in range(2):
        write(tmp_path / f"depth/{k}.png", depth(1000, 16, 16))
    with pytest.raises(ReaderError, match="register the depth"):
        open_source(tmp_path, OPTIONS)


def test_a_frame_of_another_size_is_left_out(tmp_path: Path) -> None:
    write_frames(tmp_path, "color/{}.png", "depth/{}.png")
    write(tmp_path / "color/1.png", color(1, 16, 12))
    write(tmp_path / "depth/1.png", depth(1000, 16, 12))
    source = open_source(tmp_path, OPTIONS)
    assert "1 of 4 frames cannot be read" in source.notes[0]


@pytest.mark.parametrize(("suffix", "scale"), [("png", 1000), ("PNG", 1000), ("tiff", 1), ("npy", 1)])
def test_depth_formats_of_folders_and_pairs(tmp_path: Path, suffix: str, scale: int) -> None:
    for layout, names in (
        ("folder", ("color/{}.JPG", "depth/{}." + suffix)),
        ("pair", ("color{}.BMP", "depth{}." + suffix)),
    ):
        for k in range(2):
            path = tmp_path / layout / names[1].format(k)
            path.parent.mkdir(parents=True, exist_ok=True)
            metres = np.full((HEIGHT, WIDTH), 1.25 + k, np.float32)
            ok, data = cv2.imencode(names[0][-4:].lower(), color(k))
            assert ok
            target = tmp_path / layout / names[0].format(k)
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes(data.tobytes())
            if suffix == "npy":
                np.save(path, metres)
            elif suffix == "tiff":
                tifffile.imwrite(path, metres)
            else:
                path.write_bytes(cv2.imencode(".png", (metres * 1000).astype(np.uint16))[1].tobytes())
        source = open_source(tmp_path / layout, OPTIONS)
        assert len(source) == 2
        np.testing.assert_allclose(source[1].depth, 2.25)
        scaled = open_source(tmp_path / layout, CameraOptions(intrinsics=OPTIONS.intrinsics, depth_scale=2 * scale))
        np.testing.assert_allclose(scaled[1].depth, 1.125)


def test_values_that_mark_missing_depth_and_the_largest_depth(tmp_path: Path) -> None:
    for k in range(2):
        write(tmp_path / f"color{k}.png", color(k))
        image = depth(1000)
        image[0], image[1] = 65535, 9000
        write(tmp_path / f"depth{k}.png", image)
    frame = open_source(tmp_path, OPTIONS)[0]
    assert (frame.depth[0] == 0).all()
    assert (frame.depth[1] == 9).all()
    limited = open_source(tmp_path, CameraOptions(intrinsics=OPTIONS.intrinsics, max_depth=5))[0]
    assert (limited.depth[:2] == 0).all()


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
    write_r3d(tmp_path / "a.r3d", [np.zeros((4000, 4000), np.float32)] * 2)
    with pytest.raises(ReaderError, match="depth has 64000000 bytes, not 16x12"):
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
