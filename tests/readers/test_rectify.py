"""Lens models and undistortion, compared with OpenCV's own functions and with closed forms."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from objectflow.errors import CameraError, FrameError
from objectflow.geometry.camera import Camera
from objectflow.readers.lens import make_lens
from objectflow.readers.rectify import Rectification
from objectflow.typing import UInt8Array

CAMERA = Camera(320, 240, 190.0, 195.0, 158.0, 121.5)
WIDE = (-0.30, 0.09, 0.001, -0.002, -0.01)
RATIONAL = (0.6, -2.5, 0.0005, -0.0003, 1.4, 0.5, -2.3, 1.3)
FISHEYE = (-0.02, 0.004, -0.003, 0.0005)


def picture() -> UInt8Array:
    """A smooth random colour image."""
    noise = np.random.default_rng(0).integers(0, 255, (30, 40, 3)).astype(np.uint8)
    return np.asarray(cv2.resize(noise, (320, 240), interpolation=cv2.INTER_CUBIC))


@pytest.mark.parametrize(("model", "coefficients"), [("plumb_bob", WIDE), ("rational_polynomial", RATIONAL)])
def test_colour_equals_opencvs_undistortion(model: str, coefficients: tuple[float, ...]) -> None:
    lens = make_lens(model, coefficients)
    assert lens is not None
    ours = Rectification(lens, CAMERA).color(picture())
    theirs = cv2.undistort(picture(), CAMERA.matrix, np.array(coefficients))
    difference = np.abs(ours.astype(int) - theirs)
    # OpenCV rounds its map to 1/32 pixel.
    assert difference.mean() < 0.6
    assert np.quantile(difference, 0.999) <= 8


def test_fisheye_colour_equals_opencvs_undistortion() -> None:
    lens = make_lens("equidistant", FISHEYE)
    assert lens is not None
    ours = Rectification(lens, CAMERA).color(picture())
    theirs = cv2.fisheye.undistortImage(picture(), CAMERA.matrix, np.array(FISHEYE), Knew=CAMERA.matrix)
    difference = np.abs(ours.astype(int) - theirs)
    assert difference.mean() < 0.6
    assert np.quantile(difference, 0.999) <= 8


def test_depth_takes_the_nearest_pixel() -> None:
    """Depth that equals the pixel's number shows where each value came from."""
    lens = make_lens("plumb_bob", WIDE)
    assert lens is not None
    u, v = np.meshgrid(np.arange(320.0), np.arange(240.0))
    depth = (1 + u + 1000 * v).astype(np.float32)
    found = Rectification(lens, CAMERA).depth(depth)
    source_v, source_u = np.divmod(found - 1, 1000)
    map_u, map_v = cv2.initUndistortRectifyMap(CAMERA.matrix, np.array(WIDE), None, CAMERA.matrix, (320, 240), 5)
    seen = found > 0
    assert seen.mean() > 0.95
    assert np.abs(source_u - map_u)[seen].max() <= 0.51
    assert np.abs(source_v - map_v)[seen].max() <= 0.51


def test_a_plane_stays_a_plane() -> None:
    """A wall seen by a distorting lens has its depth at every rectified pixel."""
    lens = make_lens("plumb_bob", WIDE)
    assert lens is not None
    x, y = np.meshgrid((np.arange(320) - CAMERA.cx) / CAMERA.fx, (np.arange(240) - CAMERA.cy) / CAMERA.fy)
    # The ray of a distorted pixel, by OpenCV's inverse.
    pixels = np.stack(np.meshgrid(np.arange(320.0), np.arange(240.0)), axis=-1).reshape(-1, 1, 2)
    rays = cv2.undistortPoints(pixels, CAMERA.matrix, np.array(WIDE)).reshape(240, 320, 2)
    distorted = (1 / (0.8 + 0.3 * rays[..., 0] - 0.2 * rays[..., 1])).astype(np.float32)
    depth = Rectification(lens, CAMERA).depth(distorted)
    expected = 1 / (0.8 + 0.3 * x - 0.2 * y)
    seen = depth > 0
    # Half a distorted pixel is up to one rectified pixel at the corners.
    pixel = expected**2 * (0.3 / CAMERA.fx + 0.2 / CAMERA.fy)
    error = (np.abs(depth - expected) / pixel)[seen]
    assert np.median(error) < 0.3
    assert np.quantile(error, 0.99) < 1.0


@pytest.mark.parametrize("model", ["inverse_brown_conrady", "modified_brown_conrady", "ftheta"])
def test_realsense_models_follow_librealsense(model: str) -> None:
    coefficients = (0.9,) if model == "ftheta" else (0.12, -0.2, 0.0007, -0.0004, 0.05)
    lens = make_lens(model, coefficients)
    assert lens is not None
    points = np.random.default_rng(1).uniform(-0.5, 0.5, (20, 2))
    for (x, y), (dx, dy) in zip(points, lens.distort(points), strict=True):
        if model == "ftheta":
            r = np.hypot(x, y)
            rd = 1 / 0.9 * np.arctan(2 * r * np.tan(0.45))
            assert (dx, dy) == pytest.approx((x * rd / r, y * rd / r), rel=1e-9)
            continue
        k1, k2, p1, p2, k3 = coefficients
        if model == "inverse_brown_conrady":
            # The formula leads from the image to the ray.
            r2 = dx**2 + dy**2
            f = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
            ray = (
                dx * f + 2 * p1 * dx * dy + p2 * (r2 + 2 * dx**2),
                dy * f + 2 * p2 * dx * dy + p1 * (r2 + 2 * dy**2),
            )
            assert ray == pytest.approx((x, y), abs=1e-9)
        else:
            r2 = x**2 + y**2
            f = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
            a, b = x * f, y * f
            expected = (a + 2 * p1 * a * b + p2 * (r2 + 2 * a**2), b + 2 * p2 * a * b + p1 * (r2 + 2 * b**2))
            assert (dx, dy) == pytest.approx(expected, abs=1e-12)


def test_a_lens_that_folds_back_shows_nothing_beyond_its_range() -> None:
    lens = make_lens("plumb_bob", (-0.5, 0.0, 0.0, 0.0, 0.0))
    assert lens is not None
    # r (1 - 0.5 r^2) grows up to r = sqrt(2 / 3).
    assert lens.largest_radius(2.0) == pytest.approx(np.sqrt(2 / 3), abs=0.003)
    depth = Rectification(lens, Camera(320, 240, 100.0, 100.0, 159.5, 119.5)).depth(np.ones((240, 320), np.float32))
    radius = np.hypot(*np.meshgrid(np.arange(320) - 159.5, np.arange(240) - 119.5)) / 100
    assert not depth[radius > 0.83].any()
    assert depth[radius < 0.5].all()


def test_names_and_coefficients_of_models() -> None:
    assert make_lens("plumb_bob", (0.0,) * 5) is None
    assert make_lens("", ()) is None
    assert make_lens("none", (0.0, 0.0)) is None
    unnamed, four = make_lens("", (0.1, 0.0, 0.0, 0.0)), make_lens("Brown Conrady", (0.1, 0.0, 0.0, 0.0))
    assert unnamed == four
    assert four is not None
    assert four.model == "opencv"
    with pytest.raises(CameraError, match="'spline' with 3 coefficients is not known"):
        make_lens("spline", (1.0, 2.0, 3.0))
    with pytest.raises(CameraError, match="finite"):
        make_lens("plumb_bob", (float("nan"), 0.0, 0.0, 0.0))
    with pytest.raises(CameraError, match=r"at most 1e\+06"):
        make_lens("plumb_bob", (0.1, 1e300, 0.0, 0.0))
    lens = make_lens("plumb_bob", WIDE)
    assert lens is not None
    with pytest.raises(FrameError, match="depth is 4x3, its camera is 320x240"):
        Rectification(lens, CAMERA).depth(np.ones((3, 4), np.float32))
