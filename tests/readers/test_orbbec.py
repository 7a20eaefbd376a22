"""Orbbec cameras with a stand-in for their SDK: no camera is needed, and every failure can be provoked."""

from __future__ import annotations

import importlib
import sys
from typing import Any

import cv2
import numpy as np
import pytest

from helpers.orbbec_standin import (
    HEIGHT,
    WIDTH,
    Camera,
    OBCameraDistortion,
    OBCameraDistortionModel,
    OBFormat,
    VideoStreamProfile,
)
from objectflow.cli import main
from objectflow.errors import CameraError, MissingExtraError, ReaderError
from objectflow.frame import RgbdFrame
from objectflow.readers.camera_driver import MAX_UNUSABLE, WARM_UP, StreamRequest, read_camera

PROFILE = VideoStreamProfile(OBFormat.RGB)


def rgb_image(number: int) -> Any:
    image = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    image[..., 0], image[..., 1], image[..., 2] = 20 * np.arange(WIDTH), 10 * np.arange(HEIGHT)[:, None], number % 256
    return image


def camera(**options: Any) -> Camera:
    return Camera(**{"encode": lambda number: rgb_image(number).tobytes(), "color": [PROFILE], **options})


def stream(monkeypatch: pytest.MonkeyPatch, device: Camera, request: StreamRequest | None = None) -> Any:
    monkeypatch.setitem(sys.modules, "pyorbbecsdk", device.module())
    monkeypatch.delitem(sys.modules, "objectflow.readers.orbbec", raising=False)
    return read_camera(importlib.import_module("objectflow.readers.orbbec").Orbbec(), request)


def first(monkeypatch: pytest.MonkeyPatch, device: Camera, request: StreamRequest | None = None) -> RgbdFrame:
    frames = stream(monkeypatch, device, request)
    frame: RgbdFrame = next(frames)
    frames.close()
    return frame


def test_frames_have_colour_depth_in_metres_intrinsics_and_times(monkeypatch: pytest.MonkeyPatch) -> None:
    device = camera(millimetres=lambda number: 1500.0 + number)
    frames = stream(monkeypatch, device, StreamRequest(serial="CP1"))
    one, two = next(frames), next(frames)
    frames.close()
    # The first frames are skipped until the exposure has converged.
    np.testing.assert_array_equal(one.color, rgb_image(WARM_UP))
    np.testing.assert_allclose(one.depth, 1.5 + WARM_UP / 1000, rtol=1e-6)
    np.testing.assert_allclose(two.depth, 1.5 + (WARM_UP + 1) / 1000, rtol=1e-6)
    assert one.timestamp == pytest.approx(2 + 0.033 * WARM_UP)
    assert two.timestamp == pytest.approx(2 + 0.033 * (WARM_UP + 1))
    assert one.camera.matrix.tolist() == [[9.0, 0, 3.0], [0, 9.5, 2.5], [0, 0, 1]]
    assert device.stopped == 1
    assert device.options == {"TargetDistortion": 0}
    assert device.is_silent, "the SDK writes a log into the working directory"


@pytest.mark.parametrize("form", ["BGR", "RGBA", "BGRA"])
def test_colour_formats_without_loss(monkeypatch: pytest.MonkeyPatch, form: str) -> None:
    to_format = {"BGR": [2, 1, 0], "RGBA": [0, 1, 2, 0], "BGRA": [2, 1, 0, 0]}[form]
    device = camera(
        color=[VideoStreamProfile(OBFormat[form])], encode=lambda number: rgb_image(number)[..., to_format].tobytes()
    )
    np.testing.assert_array_equal(first(monkeypatch, device).color, rgb_image(WARM_UP))


@pytest.mark.parametrize("form", ["YUYV", "YUY2", "UYVY", "NV12", "NV21", "I420"])
def test_grey_of_subsampled_formats(monkeypatch: pytest.MonkeyPatch, form: str) -> None:
    # Without chroma, ITU-R BT.601 makes grey of 255 (Y - 16) / 219.
    luma = np.add.outer(10 * np.arange(HEIGHT), 16 + 8 * np.arange(WIDTH)).astype(np.uint8)
    neutral = np.full_like(luma, 128)
    data = {"Y": np.stack([luma, neutral], axis=-1), "U": np.stack([neutral, luma], axis=-1)}.get(form[0])
    data = np.concatenate([luma, neutral[: HEIGHT // 2]]) if data is None else data
    device = camera(color=[VideoStreamProfile(OBFormat[form])], encode=lambda _: data.tobytes())
    grey = 255 * (luma.astype(float) - 16) / 219
    assert np.abs(first(monkeypatch, device).color - grey[..., None]).max() <= 1


def test_compressed_colour(monkeypatch: pytest.MonkeyPatch) -> None:
    def encode(number: int) -> bytes:
        assert number >= 0
        return bytes(cv2.imencode(".jpg", np.full((HEIGHT, WIDTH, 3), (200, 120, 40), np.uint8))[1])

    color = first(monkeypatch, camera(color=[VideoStreamProfile(OBFormat.MJPG)], encode=encode)).color
    assert np.abs(color.astype(int) - (40, 120, 200)).max() <= 3


def test_a_damaged_frame_is_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = bytes(cv2.imencode(".jpg", np.full((HEIGHT, WIDTH, 3), 90, np.uint8))[1])
    device = camera(
        color=[VideoStreamProfile(OBFormat.MJPG)],
        encode=lambda number: whole[:-30] if number == WARM_UP + 1 else whole,
        millimetres=lambda number: 0.0 if number == WARM_UP + 2 else 1000.0,
    )
    frames = stream(monkeypatch, device)
    times = [next(frames).timestamp, next(frames).timestamp]
    assert times == pytest.approx([2 + 0.033 * WARM_UP, 2 + 0.033 * (WARM_UP + 3)])


def test_a_camera_that_sees_nothing_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    device = camera(millimetres=lambda _: 0.0, count=10 * MAX_UNUSABLE)
    with pytest.raises(ReaderError, match=f"{MAX_UNUSABLE} unusable frames in a row: .*depth is missing everywhere"):
        next(stream(monkeypatch, device))
    assert device.stopped == 1


def test_depth_beyond_the_limit_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    device = camera(millimetres=lambda number: 1000.0 if number == WARM_UP + 1 else 4000.0)
    frames = stream(monkeypatch, device, StreamRequest(max_depth=3.0))
    assert next(frames).timestamp == pytest.approx(2 + 0.033 * (WARM_UP + 1))


@pytest.mark.parametrize("model", ["BROWN_CONRADY", "BROWN_CONRADY_K6"])
def test_colour_of_a_lens_is_undistorted_and_depth_is_not(monkeypatch: pytest.MonkeyPatch, model: str) -> None:
    lens = OBCameraDistortion(OBCameraDistortionModel[model], k1=-0.2, k2=0.05, k3=0.01, p1=0.01, p2=-0.02)
    coefficients = [lens.k1, lens.k2, lens.p1, lens.p2, lens.k3]
    if model == "BROWN_CONRADY_K6":
        lens.k4, lens.k5, lens.k6 = 0.1, 0.02, 0.003
        coefficients += [lens.k4, lens.k5, lens.k6]
    frame = first(monkeypatch, camera(color=[VideoStreamProfile(OBFormat.RGB, distortion=lens)]))
    expected = cv2.undistort(rgb_image(WARM_UP), frame.camera.matrix, np.array(coefficients))
    assert np.abs(frame.color.astype(int) - expected.astype(int)).max() <= 1
    assert np.abs(frame.color.astype(int) - rgb_image(WARM_UP).astype(int)).max() > 5
    # The SDK aligns depth to the pixels of a pinhole camera already.
    np.testing.assert_allclose(frame.depth, 1.5, rtol=1e-6)


def test_a_lens_of_an_unknown_model_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    lens = OBCameraDistortion(k1=-0.2)
    lens.model = type("Model", (), {"name": "SPIRAL"})()
    device = camera(color=[VideoStreamProfile(OBFormat.RGB, distortion=lens)])
    with pytest.raises(CameraError, match="SPIRAL"):
        next(stream(monkeypatch, device))
    assert device.stopped == 1


def test_the_requested_size_and_rate(monkeypatch: pytest.MonkeyPatch) -> None:
    profiles = [
        VideoStreamProfile(OBFormat.H264, 16, 12),
        VideoStreamProfile(OBFormat.MJPG, 16, 12),
        VideoStreamProfile(OBFormat.RGB, fps=30),
        VideoStreamProfile(OBFormat.RGB, fps=15),
    ]
    depth = [VideoStreamProfile(OBFormat.Y16, fps=30), VideoStreamProfile(OBFormat.Y16, fps=15)]
    device = camera(color=profiles, depth=depth)
    first(monkeypatch, device, StreamRequest(size=(WIDTH, HEIGHT), rate=15))
    assert device.started == [profiles[3], depth[1]]
    first(monkeypatch, device, StreamRequest(size=(WIDTH, HEIGHT)))
    assert device.started == [profiles[2], depth[0]]
    # The default of this camera cannot be decoded, but it has the same size in another format.
    with pytest.raises(ReaderError, match="no frame"):
        next(stream(monkeypatch, device := camera(color=profiles, depth=depth, count=0)))
    assert device.started == [profiles[1], depth[0]]
    with pytest.raises(ReaderError, match="no colour of 99x6 at 30 Hz"):
        next(stream(monkeypatch, camera(color=profiles), StreamRequest(size=(99, 6), rate=30)))


def test_missing_and_unplugged_cameras_are_reported(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(ReaderError, match=r"no Orbbec camera \(Device not found by serial number: X\)"):
        next(stream(monkeypatch, camera(), StreamRequest(serial="X")))
    stream(monkeypatch, camera(connected=False))
    assert main(["live", "orbbec", "--method", "zero"]) == 2
    error = capsys.readouterr().err
    assert error.startswith("objectflow: no Orbbec camera (No device found): plug it in")
    assert error.count("\n") == 1
    for unplugged, reason in ((True, "device disconnected"), (False, "no frame within 5 s")):
        device = camera(unplugged=unplugged, count=WARM_UP + 2)
        frames = stream(monkeypatch, device)
        assert [next(frames), next(frames)]
        with pytest.raises(ReaderError, match=f"the Orbbec camera stopped: {reason}: is it still plugged in"):
            next(frames)
        assert device.stopped == 1


def test_live_follows_a_camera(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    device = camera(count=40)
    stream(monkeypatch, device)
    code = main(["live", "orbbec", "--method", "zero", "--min-gap", "0", "--size", str(WIDTH), str(HEIGHT)])
    # The stand-in delivers all its frames at once and is silent then.
    assert code == 2
    assert "the Orbbec camera stopped: no frame within 5 s" in capsys.readouterr().err
    assert device.stopped == 1


def test_the_error_for_a_missing_library_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyorbbecsdk", None)
    monkeypatch.delitem(sys.modules, "objectflow.readers.orbbec", raising=False)
    with pytest.raises(MissingExtraError, match=r'Orbbec cameras need pyorbbecsdk: pip install ".+\[orbbec\]"'):
        importlib.import_module("objectflow.readers.orbbec")
