"""OAK cameras with a stand-in for DepthAI: no camera is needed, and every failure can be provoked."""

from __future__ import annotations

import importlib
import sys
from typing import Any

import numpy as np
import pytest

from helpers.oak_standin import CameraBoardSocket, OakCamera, Platform
from objectflow.cli import main
from objectflow.errors import MissingExtraError, ReaderError
from objectflow.readers.camera_driver import WARM_UP, StreamRequest, read_camera
from objectflow.typing import UInt8Array


def image(size: tuple[int, int], number: int) -> UInt8Array:
    out = np.zeros((size[1], size[0], 3), np.uint8)
    out[..., 0], out[..., 1], out[..., 2] = np.arange(size[0]) % 256, np.arange(size[1])[:, None] % 256, number
    return out


def stream(monkeypatch: pytest.MonkeyPatch, device: OakCamera, request: StreamRequest | None = None) -> Any:
    monkeypatch.setitem(sys.modules, "depthai", device.module())
    monkeypatch.delitem(sys.modules, "objectflow.readers.oak", raising=False)
    return read_camera(importlib.import_module("objectflow.readers.oak").Oak(), request)


@pytest.mark.parametrize("platform", Platform)
def test_frames_have_colour_depth_in_metres_intrinsics_and_times(
    monkeypatch: pytest.MonkeyPatch, platform: Platform
) -> None:
    device = OakCamera(image, millimetres=lambda number: 1500 + number, platform=platform)
    frames = stream(monkeypatch, device, StreamRequest(serial="1944", size=(320, 200), rate=20))
    one, two = next(frames), next(frames)
    frames.close()
    # The first frames are skipped until the exposure has converged.
    np.testing.assert_array_equal(one.color, image((320, 200), WARM_UP))
    np.testing.assert_allclose(one.depth, 1.5 + WARM_UP / 1000, rtol=1e-6)
    np.testing.assert_allclose(two.depth, 1.5 + (WARM_UP + 1) / 1000, rtol=1e-6)
    assert [one.timestamp, two.timestamp] == pytest.approx([100 + 0.04 * WARM_UP, 100 + 0.04 * (WARM_UP + 1)])
    assert one.camera.matrix.tolist() == [[384.0, 0, 159.0], [0, 400.0, 101.0], [0, 0, 1]]
    assert (one.camera.width, one.camera.height) == (320, 200)
    assert (device.opened, device.rate) == (["1944"], 20)
    assert (device.started, device.stopped, device.closed) == (1, 1, 1)


def test_the_default_size_and_rate(monkeypatch: pytest.MonkeyPatch) -> None:
    device = OakCamera(image)
    frame = next(stream(monkeypatch, device))
    assert (frame.camera.width, frame.camera.height, device.rate) == (640, 400, 30)


def test_a_frame_without_depth_is_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    device = OakCamera(image, millimetres=lambda number: 0 if number == WARM_UP + 1 else 900)
    frames = stream(monkeypatch, device)
    assert [next(frames).color[0, 0, 2], next(frames).color[0, 0, 2]] == [WARM_UP, WARM_UP + 2]


def test_a_camera_without_a_stereo_pair_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    device = OakCamera(image, sockets=(CameraBoardSocket.CAM_A,))
    with pytest.raises(ReaderError, match="stereo pair"):
        next(stream(monkeypatch, device))
    assert (device.started, device.closed) == (0, 1)


def test_missing_and_unplugged_cameras_are_reported(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    stream(monkeypatch, OakCamera(image))
    assert main(["live", "oak", "--method", "zero", "--serial", "nobody"]) == 2
    error = capsys.readouterr().err
    assert error.startswith("objectflow: no OAK camera (Cannot find any device with given deviceInfo): plug it in")
    assert error.count("\n") == 1
    for unplugged, reason in ((True, "MessageQueue was closed"), (False, "no frame within 5 s")):
        device = OakCamera(image, unplugged=unplugged, count=WARM_UP + 2)
        frames = stream(monkeypatch, device)
        assert [next(frames), next(frames)]
        with pytest.raises(ReaderError, match=f"the OAK camera stopped: {reason}: is it still plugged in"):
            next(frames)
        assert (device.stopped, device.closed) == (1, 1)


def test_the_error_for_a_missing_library_names_the_extra(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "depthai", None)
    monkeypatch.delitem(sys.modules, "objectflow.readers.oak", raising=False)
    with pytest.raises(MissingExtraError, match=r'OAK cameras need depthai: pip install ".+\[oak\]"'):
        importlib.import_module("objectflow.readers.oak")
    assert main(["live", "oak", "--method", "zero"]) == 2
    assert "[oak]" in capsys.readouterr().err
