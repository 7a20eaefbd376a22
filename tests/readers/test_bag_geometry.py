"""CameraInfo, lenses, frames and transforms of bags: which camera a frame gets, and which pixels."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from helpers.bags import COLOR, DEPTH, INFO, BagBuilder, Kind
from objectflow.errors import ReaderError
from objectflow.geometry.camera import Camera
from objectflow.readers import CameraOptions, open_source

CAMERA = Camera(64, 48, 60.0, 61.0, 31.0, 24.0)
OTHER = Camera(64, 48, 45.0, 45.0, 31.5, 23.5)
RAW_DEPTH = "/camera/depth/image_rect_raw"
RAW_DEPTH_INFO = "/camera/depth/camera_info"
COLOR_FRAME, DEPTH_FRAME = "camera_color_optical_frame", "camera_depth_optical_frame"
WIDE = (-0.30, 0.09, 0.001, -0.002, -0.01)


def color_image(height: int = 48, width: int = 64) -> np.ndarray[Any, Any]:
    coarse = np.random.default_rng(0).integers(0, 255, (height // 8, width // 8, 3)).astype(np.uint8)
    return cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)


def wall(camera: Camera, metres: float = 1.0) -> np.ndarray[Any, Any]:
    return np.full((camera.height, camera.width), round(1000 * metres), np.uint16)


def images(bag: BagBuilder, *, depth_topic: str = DEPTH, depth_frame: str = COLOR_FRAME, depth: Any = None) -> None:
    """Add a colour and a depth image."""
    bag.frame_id = COLOR_FRAME
    bag.image(COLOR, 5.0, color_image(), "rgb8")
    bag.frame_id = depth_frame
    bag.image(depth_topic, 5.0, wall(CAMERA) if depth is None else depth, "16UC1")
    bag.frame_id = COLOR_FRAME


@pytest.mark.parametrize("kind", ["ros1", "sqlite3", "mcap"])
def test_the_info_of_another_frame_is_refused(tmp_path: Path, kind: Kind) -> None:
    bag = BagBuilder(kind)
    images(bag)
    bag.frame_id = DEPTH_FRAME
    bag.info(RAW_DEPTH_INFO, 5.0, OTHER)
    path = bag.write(tmp_path / ("a.bag" if kind == "ros1" else "a"))
    with pytest.raises(ReaderError, match=f"no CameraInfo for .*{RAW_DEPTH_INFO} is of frame {DEPTH_FRAME}"):
        open_source(path)
    assert open_source(path, CameraOptions(intrinsics=(60.0, 61.0, 31.0, 24.0))).camera == CAMERA


def test_the_sibling_is_preferred_to_other_infos_of_the_frame(tmp_path: Path) -> None:
    bag = BagBuilder("mcap")
    images(bag)
    bag.info("/camera/aligned_depth_to_color/camera_info", 5.0, Camera(64, 48, 60.0, 61.0, 31.2, 24.0))
    bag.info("/camera/a/camera_info", 5.0, OTHER)
    assert open_source(bag.write(tmp_path / "a")).camera.cx == 31.2
    bag.info(INFO, 5.0, CAMERA)
    assert open_source(bag.write(tmp_path / "b")).camera == CAMERA


def test_the_first_valid_message_counts_and_changes_are_noted(tmp_path: Path) -> None:
    bag = BagBuilder("ros1")
    images(bag)
    bag.info(INFO, 4.0, CAMERA, size=(64, 48))
    uncalibrated = bag.messages.pop()[3]
    uncalibrated.K[:] = 0
    bag.messages.append((INFO, "sensor_msgs/msg/CameraInfo", 4 * 10**9, uncalibrated))
    bag.info(INFO, 5.0, CAMERA)
    bag.info(INFO, 5.5, CAMERA)
    assert open_source(bag.write(tmp_path / "a.bag")).notes == ()
    bag.info(INFO, 6.0, OTHER)
    source = open_source(bag.write(tmp_path / "b.bag"))
    assert source.camera == CAMERA
    assert f"{INFO} changes during the recording" in source.notes[0]


@pytest.mark.parametrize(
    ("size", "options", "expected"),
    [
        ((64, 48), {}, CAMERA),
        ((32, 24), {"binning": 2}, Camera(32, 24, 30.0, 30.5, 15.5, 12.0)),
        ((40, 32), {"roi": (10, 6, 40, 32)}, Camera(40, 32, 60.0, 61.0, 21.0, 18.0)),
        ((20, 16), {"roi": (10, 6, 40, 32), "binning": 2}, Camera(20, 16, 30.0, 30.5, 10.5, 9.0)),
        # The image is that of the whole sensor, and the region only says which part of it is of interest.
        ((64, 48), {"roi": (10, 6, 40, 32)}, CAMERA),
        # A driver that states the crop's size: K is the sensor's, or already the crop's.
        ((40, 32), {"roi": (10, 6, 40, 32), "size": (40, 32)}, Camera(40, 32, 60.0, 61.0, 21.0, 18.0)),
        # A driver that states the binned size.
        ((64, 48), {"binning": 2}, CAMERA),
    ],
)
def test_roi_and_binning(tmp_path: Path, size: tuple[int, int], options: dict[str, Any], expected: Camera) -> None:
    width, height = size
    bag = BagBuilder("mcap")
    bag.image(COLOR, 5.0, np.zeros((height, width, 3), np.uint8), "rgb8")
    bag.image(DEPTH, 5.0, np.full((height, width), 900, np.uint16), "16UC1")
    bag.info(INFO, 5.0, CAMERA, **options)
    assert open_source(bag.write(tmp_path / "a")).camera == expected


def test_a_crop_with_intrinsics_of_its_own_keeps_them(tmp_path: Path) -> None:
    camera = Camera(40, 32, 60.0, 61.0, 20.0, 15.0)
    bag = BagBuilder("mcap")
    bag.image(COLOR, 5.0, np.zeros((32, 40, 3), np.uint8), "rgb8")
    bag.image(DEPTH, 5.0, np.full((32, 40), 900, np.uint16), "16UC1")
    bag.info(INFO, 5.0, camera, roi=(10, 6, 40, 32))
    assert open_source(bag.write(tmp_path / "a")).camera == camera


def test_rectified_topics_use_the_rectified_camera(tmp_path: Path) -> None:
    bag = BagBuilder("ros1")
    bag.image("/camera/image_rect_color", 5.0, color_image(), "rgb8")
    bag.image("/camera/depth_registered", 5.0, wall(CAMERA), "16UC1")
    bag.info("/camera/camera_info", 5.0, CAMERA, D=WIDE, P=OTHER)
    source = open_source(bag.write(tmp_path / "a.bag"))
    assert source.camera == OTHER
    np.testing.assert_array_equal(source[0].color, color_image())


@pytest.mark.parametrize("kind", ["ros1", "mcap"])
def test_raw_images_of_a_lens_are_undistorted_as_by_opencv(tmp_path: Path, kind: Kind) -> None:
    bag = BagBuilder(kind)
    ramp = (1000 + np.arange(48 * 64).reshape(48, 64) // 8).astype(np.uint16)
    images(bag, depth=ramp)
    bag.info(INFO, 5.0, CAMERA, D=WIDE)
    source = open_source(bag.write(tmp_path / ("a.bag" if kind == "ros1" else "a")))
    assert source.camera == CAMERA
    assert "undistorted" in source.notes[0]
    expected = cv2.undistort(color_image(), CAMERA.matrix, np.array(WIDE))
    assert np.abs(source[0].color.astype(int) - expected).mean() < 1
    maps = cv2.initUndistortRectifyMap(CAMERA.matrix, np.array(WIDE), None, CAMERA.matrix, (64, 48), cv2.CV_32FC1)
    nearest = cv2.remap(ramp, *maps, cv2.INTER_NEAREST)
    np.testing.assert_allclose(source[0].depth[2:-2, 2:-2], nearest[2:-2, 2:-2] / 1000, atol=0.009)


def test_an_unknown_lens_is_refused(tmp_path: Path) -> None:
    bag = BagBuilder("mcap")
    images(bag)
    bag.info(INFO, 5.0, CAMERA, D=(0.1, 0.2, 0.3), model="spline")
    with pytest.raises(ReaderError, match="distortion model 'spline'"):
        open_source(bag.write(tmp_path / "a"))


def unregistered(bag: BagBuilder) -> None:
    """A wall at 1 m, seen by a depth camera of its own, 5 cm to the left of colour."""
    images(bag, depth_topic=RAW_DEPTH, depth_frame=DEPTH_FRAME)
    bag.info(INFO, 5.0, CAMERA)
    bag.frame_id = DEPTH_FRAME
    bag.info(RAW_DEPTH_INFO, 5.0, OTHER)


def test_depth_of_another_frame_is_refused_without_a_transform(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from objectflow.cli import main

    bag = BagBuilder("mcap")
    unregistered(bag)
    path = bag.write(tmp_path / "a")
    with pytest.raises(ReaderError, match=f"in frame {DEPTH_FRAME}, colour in {COLOR_FRAME}.*record depth"):
        open_source(path)
    assert main(["run", str(path), "--out", str(tmp_path / "out")]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_depth_of_another_frame_is_refused_without_its_camera(tmp_path: Path) -> None:
    bag = BagBuilder("mcap")
    images(bag, depth_topic=RAW_DEPTH, depth_frame=DEPTH_FRAME)
    bag.info(INFO, 5.0, CAMERA)
    bag.transform(DEPTH_FRAME, COLOR_FRAME, np.eye(4) + 0.05 * np.eye(4, k=3))
    with pytest.raises(ReaderError, match="depth has no CameraInfo"):
        open_source(bag.write(tmp_path / "a"))


@pytest.mark.parametrize("kind", ["ros1", "sqlite3", "mcap"])
def test_depth_is_registered_by_transforms_in_a_chain(tmp_path: Path, kind: Kind) -> None:
    bag = BagBuilder(kind)
    unregistered(bag)
    link_T_depth, link_T_color = np.eye(4), np.eye(4)
    link_T_depth[:3, :3] = link_T_color[:3, :3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]
    link_T_color[1, 3] = -0.05  # to the right of depth, whose y axis in the link's frame points to the left
    bag.transform("/camera_link", DEPTH_FRAME, link_T_depth)
    bag.transform("camera_link", COLOR_FRAME, link_T_color)
    source = open_source(bag.write(tmp_path / ("a.bag" if kind == "ros1" else "a")))
    assert source.camera == CAMERA
    assert "registered to colour by /tf_static" in source.notes[0]
    depth = source[0].depth
    np.testing.assert_allclose(depth[depth > 0], 1.0, atol=1e-6)
    # The left border of depth, at x = (-0.5 - 31.5) / 45 m, is 5 cm further left for colour.
    left = CAMERA.fx * ((-0.5 - OTHER.cx) / OTHER.fx - 0.05) + CAMERA.cx
    right = CAMERA.fx * ((63.5 - OTHER.cx) / OTHER.fx - 0.05) + CAMERA.cx
    columns = np.flatnonzero(depth[24])
    assert columns[0] == max(0, np.ceil(left))
    assert columns[-1] == min(63, np.ceil(right) - 1)


def test_equal_frames_with_other_lenses_are_registered_without_a_shift(tmp_path: Path) -> None:
    bag = BagBuilder("mcap")
    images(bag)
    bag.info(INFO, 5.0, CAMERA)
    bag.info("/camera/aligned_depth_to_color/camera_info", 5.0, OTHER)
    source = open_source(bag.write(tmp_path / "a"))
    assert "registered to colour by their common frame_id" in source.notes[0]
    assert source.camera == CAMERA


def test_aligned_depth_in_a_frame_of_its_own_is_accepted(tmp_path: Path) -> None:
    """As early versions of the RealSense driver published it."""
    bag = BagBuilder("ros1")
    images(bag, depth_frame="camera_aligned_depth_to_color_frame")
    bag.info(INFO, 5.0, CAMERA)
    bag.frame_id = "camera_aligned_depth_to_color_frame"
    bag.info("/camera/aligned_depth_to_color/camera_info", 5.0, CAMERA)
    source = open_source(bag.write(tmp_path / "a.bag"))
    np.testing.assert_allclose(source[0].depth, 1.0)
    assert source.notes == ()


def test_frames_of_one_place_need_no_registration(tmp_path: Path) -> None:
    bag = BagBuilder("mcap")
    images(bag, depth_topic=RAW_DEPTH, depth_frame=DEPTH_FRAME)
    bag.info(INFO, 5.0, CAMERA)
    bag.frame_id = DEPTH_FRAME
    bag.info(RAW_DEPTH_INFO, 5.0, CAMERA)
    bag.transform(DEPTH_FRAME, COLOR_FRAME, np.eye(4))
    source = open_source(bag.write(tmp_path / "a"))
    assert source.notes == ()
    np.testing.assert_allclose(source[0].depth, 1.0)
