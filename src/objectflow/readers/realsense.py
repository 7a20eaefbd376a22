"""Frames of an Intel RealSense camera or of its recordings, with depth aligned to colour."""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Generator, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from objectflow.errors import MissingExtraError, ReaderError
from objectflow.frame import RgbdFrame
from objectflow.geometry.camera import Camera

try:
    import pyrealsense2 as rs
except ModuleNotFoundError as error:
    raise MissingExtraError("RealSense cameras need pyrealsense2", "realsense") from error
except ImportError as error:
    raise MissingExtraError(f"pyrealsense2 is installed, but it lacks a system library: {error}") from error

WARM_UP = 15
"""Number of initial frames that are skipped until the auto-exposure has converged."""
TIMEOUT_MS = 5000
"""Longest wait for a frame, milliseconds."""


def read_realsense(
    recording: Path | None = None,
    *,
    width: int = 640,
    height: int = 480,
    rate: int = 30,
    serial: str | None = None,
    real_time: bool = False,
) -> Generator[RgbdFrame, None, None]:
    """Yield the frames of a camera endlessly, or of a recording to its end; closing the generator stops the camera.

    Args:
        recording: a file recorded by the RealSense viewer or driver, `.bag` or `.db3` (written by version 2.59); None
            opens a camera.
        width, height, rate: of colour and depth, in pixels and frames per second; ignored for recordings.
        serial: of the camera, where several are connected.
        real_time: play a recording at its original speed and drop frames that are not read in time; otherwise every
            frame is yielded.

    Raises:
        ReaderError: there is no camera, it does not support this size, it stopped delivering frames, or the recording
            cannot be read or lacks colour or depth.
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
            # Recordings do not resolve streams that are requested with an explicit format.
            config.enable_stream(rs.stream.color)
            config.enable_stream(rs.stream.depth)
            # Must be set before the pipeline starts, or the first frames are lost.
            playback = config.resolve(rs.pipeline_wrapper(pipeline)).get_device().as_playback()
            playback.set_real_time(real_time)
        profile = pipeline.start(config)
    except RuntimeError as error:
        what = f"{recording}: not a RealSense recording that can be read" if recording else "no RealSense camera"
        advice = "" if recording else ": plug it in, close other programs that use it, or try another size"
        raise ReaderError(f"{what} ({' '.join(str(error).split())}){advice}") from error
    try:
        scale = float(profile.get_device().first_depth_sensor().get_depth_scale())
        camera = _camera(profile)
        found = _aligned(pipeline, ends=recording is not None)
        if recording is None:
            for color, depth in itertools.islice(found, WARM_UP, None):
                yield _frame(color, depth, camera, scale)
        else:
            yield from _matched(found, camera, scale)
    finally:
        with contextlib.suppress(RuntimeError):  # it may have been unplugged
            pipeline.stop()


def _aligned(pipeline: Any, *, ends: bool) -> Iterator[tuple[Any, Any]]:
    """Colour and aligned depth frames as the driver combines them; `ends` marks a source that may end."""
    align = rs.align(rs.stream.color)
    while True:
        try:
            frames = align.process(pipeline.wait_for_frames(TIMEOUT_MS))
        except RuntimeError as error:
            if ends:
                return
            raise ReaderError(f"the RealSense camera stopped: {error}: is it still plugged in?") from error
        color, depth = frames.get_color_frame(), frames.get_depth_frame()
        if color and depth:
            yield color, depth


def _matched(found: Iterator[tuple[Any, Any]], camera: Camera, scale: float) -> Iterator[RgbdFrame]:
    """Each colour image once, with the depth nearest in time.

    A recording that is not played in real time yields a frame set whenever either image is new.
    """
    for _, sets in itertools.groupby(found, key=lambda pair: pair[0].get_frame_number()):
        best: tuple[float, RgbdFrame] | None = None
        for color, depth in sets:
            difference = abs(color.get_timestamp() - depth.get_timestamp())
            if best is None or difference < best[0]:
                best = difference, _frame(color, depth, camera, scale)
        if best is not None:
            yield best[1]


def _camera(profile: Any) -> Camera:
    intrinsics = profile.get_stream(rs.stream.color).as_video_stream_profile().get_intrinsics()
    size = intrinsics.width, intrinsics.height
    return Camera(*size, intrinsics.fx, intrinsics.fy, intrinsics.ppx, intrinsics.ppy)


def _frame(color: Any, depth: Any, camera: Camera, scale: float) -> RgbdFrame:
    # Copied because the driver reuses its buffers.
    pixels = np.array(color.get_data(), dtype=np.uint8)
    kind = color.get_profile().format()
    if kind not in (rs.format.rgb8, rs.format.bgr8):
        raise ReaderError(f"RealSense colour is {kind}: record it as RGB8")
    if kind == rs.format.bgr8:
        pixels = np.ascontiguousarray(pixels[..., ::-1])
    metres = np.asarray(depth.get_data(), dtype=np.float32) * np.float32(scale)
    seconds = float(color.get_timestamp()) / 1000
    return RgbdFrame(pixels, metres, camera, timestamp=seconds, name=f"RealSense at {seconds:.3f} s")
