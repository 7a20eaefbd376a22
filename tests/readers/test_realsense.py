"""The RealSense reader with a fake driver: no camera is needed, and every failure can be provoked."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

from objectflow.cli import main
from objectflow.errors import MissingExtraError, ReaderError
from objectflow.readers.camera_driver import WARM_UP

SCALE = 0.00025


class Driver:
    """A fake of the part of pyrealsense2 that the reader uses; it serves numbered frames."""

    def __init__(self, frames: int, *, plugged: bool = True) -> None:
        self.remaining, self.plugged = frames, plugged
        self.started = self.stopped = 0
        self.real_time = True
        self.streams: list[tuple[Any, ...]] = []
        self.file: tuple[str, bool] | None = None
        self.format = "rgb8"
        self.blind: set[int] = set()
        self.serial: str | None = None

    def module(self) -> ModuleType:
        out = ModuleType("pyrealsense2")
        out.pipeline = lambda: self  # type: ignore[attr-defined]
        out.config = lambda: self  # type: ignore[attr-defined]
        out.align = lambda stream: SimpleNamespace(process=lambda frames: frames)  # type: ignore[attr-defined]
        out.stream = SimpleNamespace(color="color", depth="depth")  # type: ignore[attr-defined]
        out.format = SimpleNamespace(rgb8="rgb8", bgr8="bgr8", z16="z16")  # type: ignore[attr-defined]
        out.pipeline_wrapper = lambda pipeline: pipeline  # type: ignore[attr-defined]
        return out

    # Interface of `rs.config`.
    def enable_stream(self, *values: Any) -> None:
        self.streams.append(values)

    def enable_device(self, serial: str) -> None:
        self.serial = serial

    def enable_device_from_file(self, path: str, repeat_playback: bool) -> None:
        self.file = path, repeat_playback

    def resolve(self, pipeline: Any) -> Driver:
        assert self.started == 0
        return self

    # Interface of the pipeline, its profile and its device.
    def start(self, config: Any) -> Driver:
        if not self.plugged:
            raise RuntimeError("No device connected")
        self.started += 1
        return self

    def stop(self) -> None:
        self.stopped += 1

    def get_device(self) -> Driver:
        return self

    def as_playback(self) -> Any:
        def set_real_time(value: bool) -> None:
            self.real_time = value

        return SimpleNamespace(set_real_time=set_real_time)

    def first_depth_sensor(self) -> Any:
        return SimpleNamespace(get_depth_scale=lambda: SCALE)

    def get_stream(self, kind: str) -> Any:
        intrinsics = SimpleNamespace(width=8, height=6, fx=9.0, fy=9.5, ppx=3.0, ppy=2.5)
        return SimpleNamespace(as_video_stream_profile=lambda: SimpleNamespace(get_intrinsics=lambda: intrinsics))

    def wait_for_frames(self, timeout_ms: int) -> Any:
        if self.remaining == 0:
            raise RuntimeError("Frame didn't arrive within 5000")
        self.remaining -= 1
        number = self.remaining
        # A recording yields a frame set whenever either image is new.
        count = number if self.file is None else number // 2
        color = SimpleNamespace(
            get_data=lambda: np.full((6, 8, 3), [count, 1, 2], np.uint8),
            get_timestamp=lambda: 1000.0 * (100 - count),
            get_frame_number=lambda: count,
            get_profile=lambda: SimpleNamespace(format=lambda: self.format),
        )
        behind = 0.0 if self.file is None else 40.0 * (number % 2)
        depth = SimpleNamespace(
            get_data=lambda: np.full((6, 8), 0 if count in self.blind else 4000 + int(behind), np.uint16),
            get_timestamp=lambda: 1000.0 * (100 - count) - behind,
        )
        return SimpleNamespace(get_color_frame=lambda: color, get_depth_frame=lambda: depth)


def reader(monkeypatch: pytest.MonkeyPatch, driver: Driver) -> Any:
    monkeypatch.setitem(sys.modules, "pyrealsense2", driver.module())
    monkeypatch.delitem(sys.modules, "objectflow.readers.realsense", raising=False)
    return importlib.import_module("objectflow.readers.realsense")


def test_frames_of_a_camera(monkeypatch: pytest.MonkeyPatch) -> None:
    driver = Driver(20)
    module = reader(monkeypatch, driver)
    frames = module.read_realsense(serial="123")
    first = next(frames)
    np.testing.assert_allclose(first.depth, 1.0, rtol=1e-6)
    assert (first.camera.width, first.camera.fx, first.camera.cy) == (8, 9.0, 2.5)
    # The first frames are skipped until the exposure has converged.
    assert first.color[0, 0, 0] == 20 - WARM_UP - 1
    assert first.timestamp == 100 - first.color[0, 0, 0]
    frames.close()
    assert (driver.started, driver.stopped, driver.serial) == (1, 1, "123")


def test_a_frame_without_depth_is_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    driver = Driver(20)
    driver.blind = {3}
    frames = reader(monkeypatch, driver).read_realsense()
    assert [next(frames).color[0, 0, 0], next(frames).color[0, 0, 0], next(frames).color[0, 0, 0]] == [4, 2, 1]


def test_live_requests_a_serial_number_a_size_and_a_rate(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for words, size in ((["--serial", "77", "--size", "848", "480", "--rate", "15"], (848, 480)), ([], (640, 480))):
        driver = Driver(20)
        reader(monkeypatch, driver)
        assert main(["live", "realsense", "--method", "zero", *words]) == 2
        assert "the RealSense camera stopped" in capsys.readouterr().err
        rate = 15 if words else 30
        assert driver.streams == [("color", *size, "rgb8", rate), ("depth", *size, "z16", rate)]
        assert (driver.serial, driver.stopped) == ("77" if words else None, 1)


def test_a_recording_is_read_to_its_end(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    driver = Driver(10)
    (tmp_path / "a.bag").write_bytes(b"")
    frames = list(reader(monkeypatch, driver).read_realsense(tmp_path / "a.bag"))
    # Each colour image appears once, with the depth of the same time instead of the earlier one.
    assert [frame.color[0, 0, 0] for frame in frames] == [4, 3, 2, 1, 0]
    assert all((frame.depth == 1.0).all() for frame in frames)
    assert driver.file == (str(tmp_path / "a.bag"), False)
    assert driver.streams == [("color",), ("depth",)]
    assert not driver.real_time
    assert (driver.started, driver.stopped) == (1, 1)


def test_live_plays_a_recording(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    driver = Driver(10)
    reader(monkeypatch, driver)
    (tmp_path / "a.bag").write_bytes(b"")
    driver.real_time = False
    # The fake serves all frames at once, so a method may see the newest frame only.
    code = main(["live", f"realsense:{tmp_path / 'a.bag'}", "--method", "zero", "--min-gap", "0"])
    assert driver.real_time
    assert code == 0 or "no two frames" in capsys.readouterr().err
    assert driver.stopped == 1


def test_colour_of_other_formats(monkeypatch: pytest.MonkeyPatch) -> None:
    driver = Driver(20)
    driver.format = "bgr8"
    frame = next(reader(monkeypatch, driver).read_realsense())
    assert frame.color[0, 0].tolist() == [2, 1, 4]
    driver = Driver(20)
    driver.format = "yuyv"
    with pytest.raises(ReaderError, match="yuyv"):
        next(reader(monkeypatch, driver).read_realsense())
    assert driver.stopped == 1


def test_missing_and_unplugged_cameras_are_reported(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    module = reader(monkeypatch, Driver(0, plugged=False))
    with pytest.raises(ReaderError, match=r"no RealSense camera \(No device connected\)"):
        next(module.read_realsense())
    with pytest.raises(ReaderError, match="no such file"):
        next(module.read_realsense(tmp_path / "no.bag"))
    assert main(["live", "realsense"]) == 2
    assert "no RealSense camera" in capsys.readouterr().err
    driver = Driver(17)
    with pytest.raises(ReaderError, match="still plugged in"):
        list(reader(monkeypatch, driver).read_realsense())
    assert driver.stopped == 1


def test_the_error_for_a_missing_driver_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyrealsense2", None)
    monkeypatch.delitem(sys.modules, "objectflow.readers.realsense", raising=False)
    with pytest.raises(MissingExtraError, match=r'pip install ".+\[realsense\]"'):
        importlib.import_module("objectflow.readers.realsense")
