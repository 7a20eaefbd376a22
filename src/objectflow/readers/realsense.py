"""Frames of an Intel RealSense camera or of its recordings, with depth aligned to colour."""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Generator, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from objectflow.errors import FrameError, ReaderError
from objectflow.frame import RgbdFrame
from objectflow.geometry.camera import Camera
from objectflow.readers.camera_driver import (
    TIMEOUT_MS,
    CameraDriver,
    CameraImages,
    StreamRequest,
    import_library,
    read_camera,
)
from objectflow.readers.camera_info import ImageCamera
from objectflow.storage.image_files import to_metres

rs: Any = import_library("pyrealsense2", "RealSense", "realsense")

DEFAULT_SIZE = 640, 480
"""Width and height of colour and depth, pixels, unless others are requested."""
DEFAULT_RATE = 30
"""Frames per second, unless others are requested."""


class RealSense(CameraDriver):
    """Cameras of the RealSense family by librealsense."""

    title = "RealSense"
    errors = (RuntimeError,)

    def __init__(self) -> None:
        self._pipeline: Any = None

    def open(self, request: StreamRequest) -> None:
        """Start colour and depth of one size."""
        pipeline, config = rs.pipeline(), rs.config()
        if request.serial is not None:
            config.enable_device(request.serial)
        (width, height), rate = request.size or DEFAULT_SIZE, request.rate or DEFAULT_RATE
        config.enable_stream(rs.stream.color, width, height, rs.format.rgb8, rate)
        config.enable_stream(rs.stream.depth, width, height, rs.format.z16, rate)
        profile = pipeline.start(config)
        self._pipeline, self._align = pipeline, rs.align(rs.stream.color)
        self._camera, self._scale = _camera(profile), _depth_scale(profile)

    def read(self) -> CameraImages:
        """Wait for the next images."""
        frames = self._align.process(self._pipeline.wait_for_frames(TIMEOUT_MS))
        color, depth = frames.get_color_frame(), frames.get_depth_frame()
        if not color or not depth:
            raise FrameError("a set of frames lacks colour or depth")
        return _images(color, depth, self._scale)

    def camera(self) -> ImageCamera:
        """The camera model of the colour images."""
        return ImageCamera(self._camera)

    def close(self) -> None:
        """Stop the camera."""
        if self._pipeline is not None:
            self._pipeline.stop()


def read_realsense(
    recording: Path | None = None,
    *,
    width: int = DEFAULT_SIZE[0],
    height: int = DEFAULT_SIZE[1],
    rate: int = DEFAULT_RATE,
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
    if recording is None:
        yield from read_camera(RealSense(), StreamRequest(serial, (width, height), rate))
        return
    if not recording.is_file():
        raise ReaderError(f"{recording}: no such file")
    pipeline, config = rs.pipeline(), rs.config()
    try:
        config.enable_device_from_file(str(recording), repeat_playback=False)
        # Recordings do not resolve streams that are requested with an explicit format.
        config.enable_stream(rs.stream.color)
        config.enable_stream(rs.stream.depth)
        # Must be set before the pipeline starts, or the first frames are lost.
        playback = config.resolve(rs.pipeline_wrapper(pipeline)).get_device().as_playback()
        playback.set_real_time(real_time)
        profile = pipeline.start(config)
    except RuntimeError as error:
        reason = " ".join(str(error).split())
        raise ReaderError(f"{recording}: not a RealSense recording that can be read ({reason})") from error
    try:
        yield from _matched(_recorded(pipeline), _camera(profile), _depth_scale(profile))
    finally:
        with contextlib.suppress(RuntimeError):
            pipeline.stop()


def _recorded(pipeline: Any) -> Iterator[tuple[Any, Any]]:
    """Colour and aligned depth frames as the driver combines them, to the end of a recording."""
    align = rs.align(rs.stream.color)
    while True:
        try:
            frames = align.process(pipeline.wait_for_frames(TIMEOUT_MS))
        except RuntimeError:
            return
        color, depth = frames.get_color_frame(), frames.get_depth_frame()
        if color and depth:
            yield color, depth


def _matched(found: Iterator[tuple[Any, Any]], camera: Camera, scale: float) -> Iterator[RgbdFrame]:
    """Each colour image once, with the depth nearest in time.

    A recording that is not played in real time yields a frame set whenever either image is new.
    """
    for _, sets in itertools.groupby(found, key=lambda pair: pair[0].get_frame_number()):
        best: tuple[float, CameraImages] | None = None
        for color, depth in sets:
            difference = abs(color.get_timestamp() - depth.get_timestamp())
            if best is None or difference < best[0]:
                best = difference, _images(color, depth, scale)
        if best is not None:
            images = best[1]
            name = f"RealSense at {images.seconds:.3f} s"
            metres = to_metres(images.depth, depth_scale=images.depth_scale)
            yield RgbdFrame(images.color, metres, camera, timestamp=images.seconds, name=name)


def _camera(profile: Any) -> Camera:
    intrinsics = profile.get_stream(rs.stream.color).as_video_stream_profile().get_intrinsics()
    size = intrinsics.width, intrinsics.height
    return Camera(*size, intrinsics.fx, intrinsics.fy, intrinsics.ppx, intrinsics.ppy)


def _depth_scale(profile: Any) -> float:
    """Units of depth per metre; the driver states metres per unit."""
    return 1 / float(profile.get_device().first_depth_sensor().get_depth_scale())


def _images(color: Any, depth: Any, scale: float) -> CameraImages:
    # Copied because the driver reuses its buffers.
    pixels = np.array(color.get_data(), dtype=np.uint8)
    kind = color.get_profile().format()
    if kind not in (rs.format.rgb8, rs.format.bgr8):
        raise ReaderError(f"RealSense colour is {kind}: record it as RGB8")
    if kind == rs.format.bgr8:
        pixels = np.ascontiguousarray(pixels[..., ::-1])
    values = np.array(depth.get_data(), dtype=np.uint16)
    return CameraImages(pixels, values, scale, seconds=float(color.get_timestamp()) / 1000)
