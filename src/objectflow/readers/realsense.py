"""An Intel RealSense camera, or a recording of one: depth aligned to colour, frames as they come."""

from __future__ import annotations

import contextlib
from collections.abc import Generator
from pathlib import Path
from typing import Any

import numpy as np

from objectflow.errors import MissingExtraError, ReaderError
from objectflow.frame import Camera, RgbdFrame

try:
    import pyrealsense2 as rs
except ModuleNotFoundError as error:
    raise MissingExtraError('RealSense cameras need pyrealsense2: pip install "objectflow[realsense]"') from error
except ImportError as error:
    raise MissingExtraError(f"pyrealsense2 is there, but a system library of it is not: {error}") from error

WARM_UP = 15
"""Frames left out at first, while exposure settles."""
PATIENCE_MS = 5000


def read_realsense(
    recording: Path | None = None, *, width: int = 640, height: int = 480, rate: int = 30, serial: str | None = None
) -> Generator[RgbdFrame, None, None]:
    """Frames of a camera for ever, or of a recording to its end; closing the generator stops the camera.

    Args:
        recording: a `.bag` of the RealSense viewer; None opens a camera.
        width, height, rate: of colour and depth; a recording keeps its own.
        serial: of the camera, where there are several.

    Raises:
        ReaderError: no camera, one that cannot do this size, a recording that cannot be read, or frames that stop.
    """
    if recording is not None and not recording.is_file():
        raise ReaderError(f"{recording}: no such file")
    pipeline, config = rs.pipeline(), rs.config()
    try:
        if recording is None:
            if serial is not None:
                config.enable_device(serial)
            config.enable_stream(rs.stream.color, width, height, rs.format.rgb8, rate)
            config.enable_stream(rs.stream.depth, width, height, rs.format.z16, rate)
        else:
            config.enable_device_from_file(str(recording), repeat_playback=False)
            config.enable_stream(rs.stream.color, rs.format.rgb8)
            config.enable_stream(rs.stream.depth, rs.format.z16)
        profile = pipeline.start(config)
    except RuntimeError as error:
        what = f"{recording}: not a RealSense recording that can be read" if recording else "no RealSense camera"
        advice = "" if recording else ": plug it in, close other programs that use it, or try another size"
        raise ReaderError(f"{what} ({' '.join(str(error).split())}){advice}") from error
    try:
        device = profile.get_device()
        if recording is not None:
            # Every frame, however slow the method is.
            device.as_playback().set_real_time(False)
        scale = float(device.first_depth_sensor().get_depth_scale())
        camera = _camera(profile)
        align = rs.align(rs.stream.color)
        skip = WARM_UP if recording is None else 0
        while True:
            try:
                frames = align.process(pipeline.wait_for_frames(PATIENCE_MS))
            except RuntimeError as error:
                if recording is not None:
                    return  # its end
                raise ReaderError(f"the RealSense camera stopped: {error}: is it still plugged in?") from error
            color, depth = frames.get_color_frame(), frames.get_depth_frame()
            if not color or not depth:
                continue
            if skip > 0:
                skip -= 1
                continue
            yield _frame(color, depth, camera, scale)
    finally:
        with contextlib.suppress(RuntimeError):  # it may have been unplugged
            pipeline.stop()


def _camera(profile: Any) -> Camera:
    inside = profile.get_stream(rs.stream.color).as_video_stream_profile().get_intrinsics()
    return Camera(inside.width, inside.height, inside.fx, inside.fy, inside.ppx, inside.ppy)


def _frame(color: Any, depth: Any, camera: Camera, scale: float) -> RgbdFrame:
    # Copies: the driver uses its buffers again.
    pixels = np.array(color.get_data(), dtype=np.uint8)
    metres = np.asarray(depth.get_data(), dtype=np.float32) * np.float32(scale)
    seconds = float(color.get_timestamp()) / 1000
    return RgbdFrame(pixels, metres, camera, timestamp=seconds, name=f"RealSense at {seconds:.3f} s")
