"""The RealSense reader with the real driver (extra `realsense`): recordings written by its software device.

No camera is needed. The reader has not been tested with a physical camera.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from objectflow.cli import main

rs: Any = pytest.importorskip(
    "pyrealsense2", reason="pyrealsense2 or libusb is not installed (extra `realsense`)", exc_type=ImportError
)

WIDTH, HEIGHT, FOCAL = 64, 48, 60.0
BASELINE = 0.05
"""Metres from the depth sensor to the colour sensor."""
PERIOD_MS = 1000 / 30


def stream(kind: Any, form: Any, number: int, width: int) -> Any:
    """A stream of a software device with `width` bytes per pixel."""
    intrinsics = rs.intrinsics()
    intrinsics.width, intrinsics.height, intrinsics.fx, intrinsics.fy = WIDTH, HEIGHT, FOCAL, FOCAL
    intrinsics.ppx, intrinsics.ppy, intrinsics.model, intrinsics.coeffs = 31.5, 23.5, rs.distortion.none, [0.0] * 5
    out = rs.video_stream()
    out.type, out.index, out.uid, out.fmt, out.bpp = kind, 0, number, form, width
    out.width, out.height, out.fps, out.intrinsics = WIDTH, HEIGHT, 30, intrinsics
    return out


def record(path: Path, count: int) -> None:
    """Record `count` frames at 30 Hz; colour increases in steps of 10, depth from 1 m in steps of 1 mm."""
    device = rs.software_device()
    sensor = device.add_sensor("both")
    color = sensor.add_video_stream(stream(rs.stream.color, rs.format.rgb8, 1, 3))
    depth = sensor.add_video_stream(stream(rs.stream.depth, rs.format.z16, 2, 2))
    sensor.add_read_only_option(rs.option.depth_units, 0.001)
    extrinsics = rs.extrinsics()
    extrinsics.rotation, extrinsics.translation = [1.0, 0, 0, 0, 1, 0, 0, 0, 1], [BASELINE, 0.0, 0.0]
    depth.register_extrinsics_to(color, extrinsics)
    recorder = rs.recorder(str(path), device)
    inner = recorder.query_sensors()[0]
    inner.open([color, depth])
    inner.start(rs.frame_queue(100))
    kept = []
    for number in range(count):
        for profile, pixels, width in (
            (color, np.full((HEIGHT, WIDTH, 3), 10 * number, np.uint8), 3),
            (depth, np.full((HEIGHT, WIDTH), 1000 + number, np.uint16), 2),
        ):
            frame = rs.software_video_frame()
            frame.pixels, frame.stride, frame.bpp = pixels, width * WIDTH, width
            frame.timestamp, frame.domain = 1000 + PERIOD_MS * number, rs.timestamp_domain.hardware_clock
            frame.frame_number, frame.profile = number + 1, profile.as_video_stream_profile()
            kept.append(pixels)  # The driver does not copy the pixels.
            sensor.on_video_frame(frame)
    time.sleep(0.5)  # The driver writes in another thread.
    inner.stop()
    inner.close()


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("realsense")
    for name in ("a.db3", "a.bag"):  # The supported format depends on the driver's version.
        try:
            record(folder / name, 5)
        except RuntimeError:
            continue
        return folder / name
    pytest.fail("the driver records neither .db3 nor .bag files")


def test_every_recorded_frame_has_its_own_aligned_depth(recording: Path) -> None:
    from objectflow.readers.realsense import read_realsense

    frames = list(read_realsense(recording))
    assert [frame.color[24, 32, 0] for frame in frames] == [0, 10, 20, 30, 40]
    assert [frame.timestamp for frame in frames] == pytest.approx([1 + k * PERIOD_MS / 1000 for k in range(5)])
    for number, frame in enumerate(frames):
        # The 5 cm baseline shifts depth by 3 pixels at 1 m; the depth sensor does not see the uncovered columns.
        np.testing.assert_array_equal(frame.depth[:, :2], 0)
        np.testing.assert_allclose(frame.depth[:, 4:], 1.0 + 0.001 * number, atol=1e-6)
        assert (frame.camera.width, frame.camera.fx, frame.camera.cy) == (WIDTH, FOCAL, 23.5)


def test_a_recording_is_not_accepted_as_a_bag(recording: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("rosbags", reason="rosbags is not installed (extra `bag`)")
    assert main(["run", str(recording)]) == 2
    assert f"objectflow live realsense:{recording}" in capsys.readouterr().err


def test_errors_for_an_invalid_recording_and_a_missing_camera(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "a.db3").write_bytes(b"nothing")
    assert main(["live", f"realsense:{tmp_path / 'a.db3'}"]) == 2
    assert "not a RealSense recording" in capsys.readouterr().err
    if len(rs.context().query_devices()) == 0:
        assert main(["live", "realsense"]) == 2
        assert "no RealSense camera (No device connected)" in capsys.readouterr().err
