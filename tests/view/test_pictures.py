"""Pictures of results: position and colour of what is drawn, at every image size."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from objectflow import geometry
from objectflow.errors import ResultError
from objectflow.frame import RgbdFrame
from objectflow.geometry.camera import Camera
from objectflow.motion import ObjectMotion, SceneMotion
from objectflow.typing import BoolMask, UInt8Array
from objectflow.view import draw_flow, draw_overlay, write_pictures
from objectflow.view.colors import NO_DEPTH, diverging, object_color, wheel
from objectflow.view.flow import MAX_LENGTH, flow_range


def make_frame(width: int, height: int) -> RgbdFrame:
    camera = Camera(width, height, width * 0.9, width * 0.9, (width - 1) / 2, (height - 1) / 2)
    depth = np.ones((height, width), np.float32)
    depth[:, : width // 8] = 0
    return RgbdFrame(np.full((height, width, 3), 128, np.uint8), depth, camera)


def make_motion(frame: RgbdFrame, moved: tuple[float, float, float], *, moving: bool = True) -> SceneMotion:
    """A rectangle in the image centre that moved by `moved` metres from the previous to the current frame."""
    height, width = frame.depth.shape
    labels = np.zeros((height, width), np.int32)
    labels[height // 3 : 2 * height // 3, width // 3 : 2 * width // 3] = 1
    prev_T_curr = np.eye(4)
    prev_T_curr[:3, 3] = -np.array(moved)
    flow = np.zeros((height, width, 3), np.float32)
    flow[labels == 1] = -np.array(moved)
    flow[~frame.valid] = np.nan
    obj = ObjectMotion(1, int((labels == 1).sum()), 0.9, moving, np.array([0.0, 0, 1]), prev_T_curr)
    return SceneMotion(labels=labels, scene_flow=flow, objects=(obj,), method="hand-made")


def colored(image: UInt8Array, color: tuple[int, int, int], tolerance: int = 30) -> BoolMask:
    return np.asarray(np.abs(image.astype(int) - np.array(color)).max(-1) <= tolerance)


@pytest.mark.parametrize(("width", "height"), [(160, 120), (320, 240), (640, 480), (1280, 720), (1920, 1080)])
def test_sizes_are_integer_multiples_and_large_enough(width: int, height: int) -> None:
    frame = make_frame(width, height)
    overlay = draw_overlay(frame, make_motion(frame, (0.05, 0, 0)))
    assert overlay.dtype == np.uint8
    assert overlay.shape[1] >= 960
    assert overlay.shape[1] % width == 0
    assert overlay.shape[:2] == (height * overlay.shape[1] // width, overlay.shape[1])
    flow = draw_flow(frame, make_motion(frame, (0.05, 0, 0)))
    assert flow.shape[1] >= 2 * min(max(640, width), MAX_LENGTH)


def test_the_outline_follows_the_mask() -> None:
    frame = make_frame(320, 240)
    motion = make_motion(frame, (0, 0, 0.05))
    image = draw_overlay(frame, motion)
    scale = image.shape[1] // 320
    outline = colored(image, object_color(1))
    v, u = np.nonzero(outline)
    # The mask covers columns 106..212 and rows 80..159; the tag lies above and to the right of the centre.
    left = u[(v > 100 * scale) & (v < 140 * scale)].min() / scale
    assert left == pytest.approx(106, abs=1.5)
    assert v.max() / scale == pytest.approx(160, abs=1.5)
    inside, outside = image[150 * scale, 120 * scale], image[200 * scale, 120 * scale]
    assert int(inside[0]) - int(inside[2]) > 40  # Tinted with the object's red.
    assert abs(int(outside[0]) - int(outside[2])) < 3  # The grey background stays grey.


def test_static_objects_are_outlined_but_not_filled() -> None:
    frame = make_frame(320, 240)
    image = draw_overlay(frame, make_motion(frame, (0, 0, 0), moving=False))
    scale = image.shape[1] // 320
    inside = image[150 * scale, 120 * scale]
    assert abs(int(inside[0]) - int(inside[2])) < 3
    assert colored(image, object_color(1)).any()


def test_the_arrow_runs_from_the_previous_to_the_current_centre() -> None:
    frame = make_frame(640, 480)
    static, moved = (draw_overlay(frame, make_motion(frame, (x, 0, 0))) for x in (0.0, 0.10))
    changed = np.abs(static.astype(int) - moved.astype(int)).max(-1) > 60
    row = changed[int((239.5 + 0.5) * 2)]
    u = np.nonzero(row)[0] / 2
    # 10 cm at 1 m with f = 576: the tail lies 57.6 pixels left of the centre at 319.5.
    assert u.min() == pytest.approx(319.5 - 57.6, abs=6)
    assert u.max() <= 319.5 + 6


@pytest.mark.parametrize("center", [(0.0, 0.0, -1.0), (50.0, 0.0, 0.1), (0.0, 0.0, 1e-9)])
def test_objects_with_a_centre_out_of_view_are_drawn(center: tuple[float, float, float]) -> None:
    frame = make_frame(320, 240)
    motion = make_motion(frame, (0.05, 0, 0))
    hidden = ObjectMotion(1, 5, 0.5, True, np.array(center), motion.objects[0].prev_T_curr)
    image = draw_overlay(frame, SceneMotion(motion.labels, motion.scene_flow, (hidden,)))
    assert colored(image, object_color(1)).any()


def test_flow_panels_show_direction_depth_and_missing_pixels() -> None:
    frame = make_frame(640, 480)
    sheet = draw_flow(frame, make_motion(frame, (0.05, 0, -0.05)))
    left_panel, right_panel = sheet[34:514, 14:654], sheet[34:514, 668:1308]
    red_right = left_panel[240, 320].astype(int)
    assert red_right[0] > red_right[2] + 50  # Motion to the right is red on the wheel.
    toward = right_panel[240, 320].astype(int)
    assert toward[0] > toward[2] + 50  # Motion towards the camera is red.
    for panel in (left_panel, right_panel):
        assert np.ptp(panel[100, 300]) <= 1  # Static points are grey to white.
        np.testing.assert_allclose(panel[240, 20], np.array(NO_DEPTH) * 0.92, atol=1)


def test_an_empty_result_has_no_colour() -> None:
    frame = make_frame(320, 240)
    labels, flow = np.zeros((240, 320), np.int32), np.full((240, 320, 3), np.nan, np.float32)
    motion = SceneMotion(labels, flow)
    assert np.ptp(draw_overlay(frame, motion).astype(int), axis=-1).max() <= 1
    assert draw_flow(frame, motion).shape[2] == 3


@pytest.mark.parametrize(
    ("length", "expected"), [(0.001, 0.01), (0.012, 0.015), (0.05, 0.05), (0.0501, 0.06), (0.9, 1.0), (2.2, 3.0)]
)
def test_the_range_is_round_and_covers_the_flow(length: float, expected: float) -> None:
    moved = np.zeros((1000, 3))
    moved[:50, 1] = length
    assert flow_range(moved) == pytest.approx(expected)


def test_the_wheel_is_white_at_rest_and_directions_are_distinguishable() -> None:
    angles = np.arange(12) * np.pi / 6
    ring = wheel(np.cos(angles), np.sin(angles)).astype(int)
    assert wheel(np.array(0.0), np.array(0.0)).tolist() == [255, 255, 255]
    differences = np.abs(ring[:, None] - ring[None]).max(-1)[~np.eye(12, dtype=bool)]
    assert differences.min() > 30
    assert (wheel(np.array(5.0), np.array(0.0)) == ring[0]).all()


def test_the_diverging_map_is_white_at_zero_with_opposite_ends() -> None:
    low, zero, high = diverging(np.array([-1.0, 0.0, 1.0])).astype(int)
    assert zero.tolist() == [255, 255, 255]
    assert low[0] > low[2] + 80
    assert high[2] > high[0] + 80


def test_object_colours_differ() -> None:
    palette = np.array([object_color(i) for i in range(1, 9)])
    differences = np.abs(palette[:, None] - palette[None]).max(-1)[~np.eye(8, dtype=bool)]
    assert differences.min() > 45
    many = {object_color(i) for i in range(1, 61)}
    assert len(many) == 60
    assert all(0 <= value <= 255 for color in many for value in color)


def test_text_is_drawn_without_truetype_fonts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(cv2, "FontFace", raising=False)
    frame = make_frame(320, 240)
    sheet = draw_flow(frame, make_motion(frame, (0.05, 0, 0)))
    title = sheet[:30, 14:400].min(-1)
    assert 200 < (title < 100).sum() < 6000


def test_files_hold_the_pictures(tmp_path: Path) -> None:
    frame = make_frame(320, 240)
    motion = make_motion(frame, (0.05, 0, 0))
    write_pictures(tmp_path, frame, motion)
    stored = cv2.cvtColor(cv2.imread(str(tmp_path / "overlay.png")), cv2.COLOR_BGR2RGB)
    np.testing.assert_array_equal(stored, draw_overlay(frame, motion))
    assert cv2.imread(str(tmp_path / "flow.png")) is not None
    with pytest.raises(ResultError):
        write_pictures(tmp_path, make_frame(160, 120), motion)


def test_captions_leave_arrows_free() -> None:
    camera = Camera(320, 240, 300.0, 300.0, 159.5, 119.5)
    labels = np.zeros((240, 320), np.int32)
    labels[110:170, 120:200] = 1
    frame = RgbdFrame(np.full((240, 320, 3), 90, np.uint8), np.full((240, 320), 0.8, np.float32), camera)
    center = geometry.back_project_pixels(np.array([159.5, 139.5]), 0.8, camera)
    before = geometry.make_transform(np.eye(3), [0.0, -0.25, 0.0])  # The arrow comes from 94 pixels above.
    flow = np.zeros((240, 320, 3), np.float32)
    flow[labels == 1] = before[:3, 3]
    motion = SceneMotion(labels, flow, (ObjectMotion(1, 4800, 0.9, True, center, before),))
    image = draw_overlay(frame, motion).astype(int)
    scale = image.shape[1] // 320
    # The strips beside the arrow, above the mask, show the grey frame.
    for column in (159.5 - 5, 159.5 + 5):
        strip = image[50 * scale : 104 * scale, round(column * scale)]
        assert (strip.max(axis=1) < 200).all()
