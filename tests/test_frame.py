"""Checks of cameras and frames, and the geometry of other resolutions."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from objectflow import Camera, RgbdFrame, geometry
from objectflow.errors import CameraError, FrameError, ReaderError
from objectflow.frame import check_pair
from objectflow.typing import Float64Array

CAMERA = Camera(width=16, height=12, fx=20.0, fy=21.0, cx=7.0, cy=5.0)
VALUES = CAMERA.to_dict()
COLOR = np.random.default_rng(0).integers(0, 256, (12, 16, 3), dtype=np.uint8)
DEPTH = np.random.default_rng(1).uniform(0.5, 2, (12, 16)).astype(np.float32)


def frame(**changes: Any) -> RgbdFrame:
    arguments: dict[str, Any] = {"color": COLOR, "depth": DEPTH, "camera": CAMERA, "name": "here"}
    return RgbdFrame(**(arguments | changes))


# --- Camera ---


def test_a_camera_stores_plain_numbers() -> None:
    camera = Camera(*[np.float32(v) for v in (16, 12, 20, 21, 7, 5)])  # type: ignore[arg-type]
    assert camera == CAMERA
    assert [type(v) for v in camera.to_dict().values()] == [int, int, float, float, float, float]
    np.testing.assert_array_equal(camera.matrix, [[20, 0, 7], [0, 21, 5], [0, 0, 1]])
    assert Camera.from_dict(camera.to_dict() | {"note": "more"}) == camera


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"fx": "20"}, "fx must be a number, not '20'"),
        ({"cy": None}, "cy must be a number"),
        ({"width": True}, "width must be a number"),
        ({"fy": float("nan")}, "fy must be .*finite"),
        ({"cx": float("inf")}, "cx must be .*finite"),
        ({"width": 10**400}, "width must be .*finite"),
        ({"width": 16.5}, "whole and positive"),
        ({"height": 0}, "whole and positive"),
        ({"height": -12}, "whole and positive"),
        ({"fx": 0}, "focal lengths must be positive"),
        ({"fy": -21.0}, "focal lengths must be positive"),
        ({"cx": 321.0}, "another resolution"),
        ({"cy": -240.5}, "another resolution"),
        ({"fx": 1.0}, "in pixels"),
        ({"fy": 615.0}, "in pixels"),
    ],
)
def test_impossible_cameras_are_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(CameraError, match=message):
        Camera(**(VALUES | changes))


def points_in_view(count: int = 50) -> Float64Array:
    rng = np.random.default_rng(2)
    pixels, z = rng.uniform([0, 0], [15, 11], (count, 2)), rng.uniform(0.5, 2, count)
    return np.stack([(pixels[:, 0] - 7) / 20 * z, (pixels[:, 1] - 5) / 21 * z, z], axis=-1)


@given(st.integers(1, 64), st.integers(1, 64))
@settings(derandomize=True, deadline=None, max_examples=40, database=None)
def test_a_scaled_camera_projects_points_to_the_same_relative_positions(width: int, height: int) -> None:
    before = geometry.project(points_in_view(), CAMERA)
    after = geometry.project(points_in_view(), CAMERA.scaled(width, height))
    # Relative positions are measured from the corner of the image, half a pixel before the first centre.
    np.testing.assert_allclose((after + 0.5) / [width, height], (before + 0.5) / [16, 12], atol=1e-12)


@given(st.integers(1, 4000), st.integers(1, 4000))
@settings(derandomize=True, deadline=None, max_examples=100, database=None)
def test_scaling_keeps_a_principal_point_on_the_border_inside(width: int, scaled: int) -> None:
    camera = Camera(width, width, width, width, width - 0.5, -0.5)
    assert camera.scaled(scaled, scaled).cx == scaled - 0.5


def test_a_cropped_camera_shifts_projections() -> None:
    before = geometry.project(points_in_view(), CAMERA)
    after = geometry.project(points_in_view(), CAMERA.cropped(2, 3, 10, 8))
    np.testing.assert_allclose(after, before - [2, 3], atol=1e-12)
    assert CAMERA.cropped(0, 0, 16, 12) == CAMERA


def test_a_crop_need_not_contain_the_principal_point() -> None:
    crop = CAMERA.cropped(10, 0, 6, 12)
    assert crop.cx == CAMERA.cx - 10 < 0


@pytest.mark.parametrize(
    ("crop", "message"),
    [
        ((-1, 0, 8, 8), "start inside the 16x12 image"),
        ((9, 0, 8, 8), "leaves"),
        ((0, 5, 8, 8), "leaves"),
        ((2, 2, 0, 5), "whole and positive"),
    ],
)
def test_impossible_crops_are_refused(crop: tuple[int, int, int, int], message: str) -> None:
    with pytest.raises(CameraError, match=message):
        CAMERA.cropped(*crop)


def test_camera_files_are_read_with_their_depth_scale(tmp_path: Path) -> None:
    path = tmp_path / "camera.json"
    path.write_text(json.dumps(VALUES))
    assert Camera.read(path) == (CAMERA, None)
    path.write_text(json.dumps(VALUES | {"depth_scale": 5000}))
    assert Camera.read(str(path)) == (CAMERA, 5000.0)


@pytest.mark.parametrize(
    ("content", "error", "message"),
    [
        (b"", ReaderError, "not a JSON file"),
        (b"fx: 20", ReaderError, "not a JSON file"),
        (b"\xff\xfe\x00", ReaderError, "not a JSON file"),
        (b"[" * 100_000, ReaderError, "not a JSON file"),
        (b"[1, 2]", ReaderError, "expected a JSON object"),
        (b"{}", CameraError, "width, height, fx, fy, cx, cy missing"),
        (json.dumps(VALUES | {"fx": "20"}).encode(), CameraError, "fx must be a number"),
        (json.dumps(VALUES | {"width": 10**400}).encode(), CameraError, "width must be"),
        (json.dumps(VALUES | {"depth_scale": 0}).encode(), FrameError, "depth_scale must be a positive"),
        (json.dumps(VALUES | {"depth_scale": 10**400}).encode(), FrameError, "depth_scale must be a positive"),
        (json.dumps(VALUES | {"depth_scale": 1e39}).encode(), FrameError, "depth_scale must be at most 1e"),
        (json.dumps(VALUES | {"depth_scale": [1]}).encode(), FrameError, "depth_scale must be a number"),
    ],
)
def test_invalid_camera_files_are_refused(
    tmp_path: Path, content: bytes, error: type[Exception], message: str
) -> None:
    path = tmp_path / "camera.json"
    path.write_bytes(content)
    with pytest.raises(error, match=message) as caught:
        Camera.read(path)
    assert "camera.json" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_camera_files_that_cannot_be_read_are_named(tmp_path: Path) -> None:
    with pytest.raises(ReaderError, match=r"nowhere\.json: no such camera file"):
        Camera.read(tmp_path / "nowhere.json")
    with pytest.raises(ReaderError, match="a camera file must be a regular file"):
        Camera.read(tmp_path)


# --- RgbdFrame ---


def test_a_frame_keeps_its_arrays() -> None:
    made = frame(timestamp=1.5)
    np.testing.assert_array_equal(made.color, COLOR)
    np.testing.assert_array_equal(made.depth, DEPTH)
    assert (made.timestamp, made.name) == (1.5, "here")


def test_depth_of_other_floats_becomes_float32_and_views_become_contiguous() -> None:
    made = frame(color=COLOR[:, ::-1], depth=DEPTH.astype(np.float64)[::-1])
    assert made.depth.dtype == np.float32
    assert made.depth.flags.c_contiguous
    assert made.color.flags.c_contiguous
    np.testing.assert_array_equal(made.depth, DEPTH[::-1])


def test_valid_marks_pixels_with_depth() -> None:
    depth = DEPTH.copy()
    depth[2, 3] = 0
    assert np.argwhere(~frame(depth=depth).valid).tolist() == [[2, 3]]


def changed(value: float) -> Float64Array:
    depth = DEPTH.astype(np.float64)
    depth[1, 2] = value
    return depth


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"color": COLOR[..., 0]}, r"colour must be an \(H, W, 3\) array"),
        ({"color": COLOR[..., :2]}, r"colour must be an \(H, W, 3\) array, not an array of shape \(12, 16, 2\)"),
        ({"color": COLOR / np.float32(255)}, "colour must be uint8"),
        ({"color": COLOR.astype(np.uint16)}, "colour must be uint8"),
        ({"depth": None}, "depth must be .* not NoneType"),
        ({"depth": (DEPTH * 1000).astype(np.uint16)}, "depth must be float32 metres, not uint16"),
        ({"depth": DEPTH.astype(np.complex64)}, "depth must be float32 metres"),
        ({"depth": DEPTH[:, :8]}, "colour is 16x12, depth 8x12: register"),
        ({"camera": CAMERA.scaled(32, 24)}, "the images are 16x12, the camera is 32x24"),
        ({"camera": CAMERA.matrix}, "camera must be an objectflow.Camera, not ndarray"),
        ({"depth": np.zeros_like(DEPTH)}, "missing everywhere"),
        ({"depth": DEPTH * 1000}, "millimetres"),
        ({"depth": DEPTH / 1000}, "check the depth scale"),
        ({"depth": changed(np.nan)}, "1 depth values are NaN or infinite: mark missing depth with 0"),
        ({"depth": changed(-np.inf)}, "NaN or infinite"),
        ({"depth": changed(-0.5)}, "1 depth values are negative"),
        ({"depth": changed(1e300)}, "NaN or infinite"),  # finite as a double, not as a float32
        ({"depth": np.full_like(DEPTH, 1e-60, dtype=np.float64)}, "missing everywhere"),
    ],
)
def test_invalid_frames_are_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(FrameError, match=message) as caught:
        frame(**changes)
    assert str(caught.value).startswith("here: ")


def test_a_few_far_or_near_pixels_are_accepted() -> None:
    depth = DEPTH.copy()
    depth[0, :3] = [300, 0.001, 0]
    np.testing.assert_array_equal(frame(depth=depth).depth, depth)


def test_pairs_must_have_one_size_and_one_camera() -> None:
    check_pair(frame(), frame())
    with pytest.raises(FrameError, match="the previous frame is 16x12, the current one 8x6"):
        check_pair(frame(), frame().resized(8, 6))
    other = Camera(16, 12, 20.0, 20.0, 7.0, 5.0)
    with pytest.raises(FrameError, match="different intrinsics"):
        check_pair(frame(), frame(camera=other))


# --- RgbdFrame.resized ---


@pytest.mark.parametrize("size", [(8, 6), (4, 3), (32, 24), (11, 7), (40, 5), (16, 12)])
def test_resizing_keeps_the_geometry(size: tuple[int, int]) -> None:
    v, u = np.mgrid[0:12, 0:16]
    rays = np.stack([(u - 7) / 20, (v - 5) / 21, np.ones_like(u)], axis=-1)
    normal, distance = np.array([0.1, -0.2, 1]), 1.0
    plane = frame(depth=(distance / (rays @ normal)).astype(np.float32)).resized(*size)
    assert plane.depth.shape == size[::-1]
    assert plane.color.shape == (*size[::-1], 3)
    points = geometry.back_project(plane.depth, plane.camera)
    # The nearest pixel is at most half an old pixel away, here 1/40 of a ray, and the plane has a slope of 0.2.
    np.testing.assert_allclose(points @ normal, distance, atol=(0.1 / 40 + 0.2 / 42) * 1.5)


def test_shrinking_samples_the_centres_of_blocks_and_never_mixes_depths() -> None:
    small = frame().resized(8, 6)
    np.testing.assert_array_equal(small.depth, DEPTH[1::2, 1::2])
    blocks = COLOR.astype(float).reshape(6, 2, 8, 2, 3).mean((1, 3))
    np.testing.assert_allclose(small.color, blocks, atol=0.51)
    np.testing.assert_array_equal(frame().resized(5, 4).depth, DEPTH[1::3][:, [1, 4, 8, 11, 14]])


@pytest.mark.parametrize("size", [(0, 6), (8, -1), (2.5, 4)])
def test_resizing_to_an_impossible_size_is_refused(size: tuple[int, int]) -> None:
    with pytest.raises(CameraError, match="whole and positive"):
        frame().resized(*size)


# --- RgbdFrame.read ---


@pytest.fixture
def pair(tmp_path: Path) -> tuple[Path, Path]:
    color, depth = tmp_path / "color.png", tmp_path / "depth.png"
    cv2.imwrite(str(color), COLOR[..., ::-1])
    cv2.imwrite(str(depth), np.rint(DEPTH * 1000).astype(np.uint16))
    return color, depth


def test_images_are_read_as_rgb_and_metres(pair: tuple[Path, Path]) -> None:
    read = RgbdFrame.read(*pair, camera=CAMERA, timestamp=2.0)
    np.testing.assert_array_equal(read.color, COLOR)
    np.testing.assert_allclose(read.depth, DEPTH, atol=0.000501)
    assert read.timestamp == 2.0
    finer = RgbdFrame.read(*pair, camera=CAMERA, depth_scale=5000)
    np.testing.assert_allclose(finer.depth * 5, read.depth, rtol=1e-6)


def test_grey_and_transparent_colour_images_are_read(pair: tuple[Path, Path]) -> None:
    color, depth = pair
    cv2.imwrite(str(color), COLOR[..., 0])
    np.testing.assert_array_equal(
        RgbdFrame.read(color, depth, camera=CAMERA).color, np.repeat(COLOR[..., :1], 3, axis=2)
    )
    alpha = np.concatenate([COLOR[..., ::-1], np.full((12, 16, 1), 9, np.uint8)], axis=2)
    cv2.imwrite(str(color), alpha)
    np.testing.assert_array_equal(RgbdFrame.read(color, depth, camera=CAMERA).color, COLOR)


def test_bytes_after_the_end_of_a_png_are_ignored(pair: tuple[Path, Path]) -> None:
    pair[1].write_bytes(pair[1].read_bytes() + b"written by a camera driver of some kind")
    np.testing.assert_allclose(RgbdFrame.read(*pair, camera=CAMERA).depth, DEPTH, atol=0.000501)


def encoded(kind: str, image: NDArray[Any]) -> bytes:
    return cv2.imencode(kind, image)[1].tobytes()


@pytest.mark.parametrize(
    ("index", "content", "message"),
    [
        (0, None, "color.png: no such file"),
        (1, None, "depth.png: no such file"),
        (0, b"", "color.png: not an image"),
        (1, b"these are words", "depth.png: not an image"),
        (0, encoded(".png", COLOR)[:-30], "color.png: the PNG is cut off"),
        (0, encoded(".jpg", COLOR)[:-30], "color.png: the JPEG is cut off"),
        (0, encoded(".png", DEPTH.astype(np.uint16)), "are colour and depth swapped"),
        (1, encoded(".png", COLOR), "depth.png: a depth image has one channel, this has 3"),
        (1, encoded(".png", COLOR[..., 0]), "depth.png: a depth image has 16 bits per pixel, this has 8"),
        (1, encoded(".png", np.dstack([DEPTH] * 3).astype(np.uint16)), "one channel"),
    ],
)
def test_files_that_form_no_frame_are_refused(
    pair: tuple[Path, Path], index: int, content: bytes | None, message: str
) -> None:
    if content is None:
        pair[index].unlink()
    else:
        pair[index].write_bytes(content)
    with pytest.raises(ReaderError, match=message):
        RgbdFrame.read(*pair, camera=CAMERA)


def test_a_folder_is_no_image(pair: tuple[Path, Path]) -> None:
    with pytest.raises(ReaderError, match="cannot be read"):
        RgbdFrame.read(pair[0].parent, pair[1], camera=CAMERA)


@pytest.mark.parametrize("scale", [0, -1000, float("nan"), float("inf"), "1000", True, None, 10**400])
def test_invalid_depth_scales_are_refused(pair: tuple[Path, Path], scale: Any) -> None:
    with pytest.raises(FrameError, match="depth_scale must be a"):
        RgbdFrame.read(*pair, camera=CAMERA, depth_scale=scale)


@pytest.mark.parametrize(("scale", "message"), [(1, "millimetres"), (1e9, "check the depth scale"), (1e-300, "NaN")])
def test_implausible_depth_scales_are_refused(pair: tuple[Path, Path], scale: float, message: str) -> None:
    with pytest.raises(FrameError, match=message):
        RgbdFrame.read(*pair, camera=CAMERA, depth_scale=scale)


def test_a_cropped_frame_back_projects_to_the_same_points() -> None:
    rng = np.random.default_rng(0)
    camera = Camera(width=40, height=30, fx=50.0, fy=52.0, cx=19.0, cy=14.0)
    depth = rng.uniform(0.5, 1.5, (30, 40)).astype(np.float32)
    color = rng.integers(0, 256, (30, 40, 3)).astype(np.uint8)
    part = RgbdFrame(color, depth, camera, timestamp=2.0).cropped(7, 5, 20, 12)
    points = geometry.back_project(depth, camera)[5:17, 7:27]
    np.testing.assert_allclose(geometry.back_project(part.depth, part.camera), points, atol=1e-6)
    np.testing.assert_array_equal(part.color, color[5:17, 7:27])
    assert part.timestamp == 2.0
    with pytest.raises(CameraError, match="leaves the 40x30 image"):
        RgbdFrame(color, depth, camera).cropped(30, 5, 20, 12)
