"""A stand-in for pyorbbecsdk with one camera, whose frames the tests choose.

`tests/readers/test_camera_libraries.py` compares its names and parameters with those of the real library.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from enum import Enum
from types import ModuleType
from typing import Any

import numpy as np

from objectflow.typing import UInt8Array

WIDTH, HEIGHT = 8, 6
BUFFER = 4096
"""Bytes of the buffer of each kind of frame, more than any frame of the tests has."""
K = {"width": WIDTH, "height": HEIGHT, "fx": 9.0, "fy": 9.5, "cx": 3.0, "cy": 2.5}


class OBError(Exception):
    """The exception of the SDK."""


OBFormat = Enum("OBFormat", "RGB BGR RGBA BGRA MJPG YUYV YUY2 UYVY NV12 NV21 I420 H264 Y16")
OBSensorType = Enum("OBSensorType", "COLOR_SENSOR DEPTH_SENSOR")
OBStreamType = Enum("OBStreamType", "COLOR_STREAM DEPTH_STREAM")
OBLogLevel = Enum("OBLogLevel", "NONE ERROR")
OBFrameAggregateOutputMode = Enum("OBFrameAggregateOutputMode", "FULL_FRAME_REQUIRE ANY_SITUATION")
OBCameraDistortionModel = Enum(
    "OBCameraDistortionModel",
    "NONE BROWN_CONRADY BROWN_CONRADY_K6 MODIFIED_BROWN_CONRADY INVERSE_BROWN_CONRADY KANNALA_BRANDT4",
)


@dataclass
class OBCameraIntrinsic:
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float


@dataclass
class OBCameraDistortion:
    model: OBCameraDistortionModel = OBCameraDistortionModel.NONE
    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0
    k5: float = 0.0
    k6: float = 0.0
    p1: float = 0.0
    p2: float = 0.0


@dataclass
class VideoStreamProfile:
    form: OBFormat
    width: int = WIDTH
    height: int = HEIGHT
    fps: int = 30
    distortion: OBCameraDistortion = field(default_factory=OBCameraDistortion)

    def get_format(self) -> OBFormat:
        return self.form

    def get_width(self) -> int:
        return self.width

    def get_height(self) -> int:
        return self.height

    def get_fps(self) -> int:
        return self.fps

    def get_intrinsic(self) -> OBCameraIntrinsic:
        return OBCameraIntrinsic(**K)

    def get_distortion(self) -> OBCameraDistortion:
        return self.distortion

    def as_video_stream_profile(self) -> VideoStreamProfile:
        return self


@dataclass
class StreamProfileList:
    profiles: list[VideoStreamProfile]

    def get_default_video_stream_profile(self) -> VideoStreamProfile:
        return self.profiles[0]

    def get_video_stream_profile(self, width: int, height: int, format: OBFormat, fps: int) -> VideoStreamProfile:
        for one in self.profiles:
            if (one.width, one.height, one.form) == (width, height, format) and fps in (0, one.fps):
                return one
        raise OBError("Invalid input, No matched video stream profile found!")


class VideoFrame:
    """A frame of the camera; its buffer is reused for the next one, as in the SDK."""

    def __init__(self, data: UInt8Array, profile: VideoStreamProfile, microseconds: int, scale: float = 1.0) -> None:
        self._data, self._profile, self._microseconds, self._scale = data, profile, microseconds, scale

    def get_data(self) -> UInt8Array:
        return self._data

    def get_format(self) -> OBFormat:
        return self._profile.form

    def get_width(self) -> int:
        return self._profile.width

    def get_height(self) -> int:
        return self._profile.height

    def get_timestamp_us(self) -> int:
        return self._microseconds

    def get_stream_profile(self) -> VideoStreamProfile:
        return self._profile


class DepthFrame(VideoFrame):
    def get_depth_scale(self) -> float:
        return self._scale


class ColorFrame(VideoFrame):
    pass


class FrameSet:
    def __init__(self, color: ColorFrame | None, depth: DepthFrame | None) -> None:
        self._color, self._depth = color, depth

    def as_frame_set(self) -> FrameSet:
        return self

    def get_color_frame(self) -> ColorFrame | None:
        return self._color

    def get_depth_frame(self) -> DepthFrame | None:
        return self._depth


@dataclass
class Camera:
    """What the camera has and delivers, and what was done to it.

    Attributes:
        encode: makes the colour data of a frame from its number.
        millimetres: of all depth pixels of a frame, by its number.
        scale: of depth, millimetres per unit.
        count: number of frames until the camera is silent.
        unplugged: an error is raised after `count` frames, in place of silence.
    """

    encode: Callable[[int], bytes]
    color: list[VideoStreamProfile]
    depth: list[VideoStreamProfile] = field(default_factory=lambda: [VideoStreamProfile(OBFormat.Y16)])
    millimetres: Callable[[int], float] = lambda _: 1500.0
    scale: float = 0.5
    count: int = 20
    connected: bool = True
    unplugged: bool = False
    serial: str = "CP1"
    started: list[VideoStreamProfile] = field(default_factory=list)
    stopped: int = 0
    options: dict[str, float] = field(default_factory=dict)
    is_silent: bool = False

    def module(self) -> ModuleType:
        """The module to put into `sys.modules`."""
        camera = self

        class Context:
            @staticmethod
            def set_logger_level(arg0: OBLogLevel) -> None:
                camera.is_silent = arg0 is OBLogLevel.NONE

            def query_devices(self) -> DeviceList:
                return DeviceList()

        class DeviceList:
            def get_device_by_serial_number(self, serial_number: str) -> str:
                if serial_number != camera.serial:
                    raise OBError(f"Device not found by serial number: {serial_number}")
                return serial_number

        class Config:
            def __init__(self) -> None:
                self.streams: list[VideoStreamProfile] = []

            def enable_stream(self, arg0: VideoStreamProfile) -> None:
                self.streams.append(arg0)

            def set_frame_aggregate_output_mode(self, arg0: OBFrameAggregateOutputMode) -> None:
                assert arg0 is OBFrameAggregateOutputMode.FULL_FRAME_REQUIRE

        class Pipeline:
            def __init__(self, arg0: str | None = None) -> None:
                if not camera.connected:
                    raise RuntimeError("No device found")
                self._number = 0
                self._buffers: dict[str, UInt8Array] = {}

            def get_stream_profile_list(self, arg0: OBSensorType) -> StreamProfileList:
                return StreamProfileList(camera.color if arg0 is OBSensorType.COLOR_SENSOR else camera.depth)

            def enable_frame_sync(self) -> None:
                raise OBError("not supported by this camera")

            def start(self, arg0: Config) -> None:
                camera.started = arg0.streams

            def stop(self) -> None:
                camera.stopped += 1
                if camera.unplugged:
                    raise OBError("device is gone")

            def wait_for_frames(self, arg0: int) -> FrameSet | None:
                number, self._number = self._number, self._number + 1
                if number >= camera.count:
                    if camera.unplugged:
                        raise OBError("device disconnected")
                    return None
                color, depth = camera.started
                units = np.full(depth.width * depth.height, camera.millimetres(number) / camera.scale, np.uint16)
                microseconds = 2_000_000 + 33_000 * number
                return FrameSet(
                    ColorFrame(self._store("color", camera.encode(number)), color, microseconds),
                    DepthFrame(self._store("depth", units.tobytes()), depth, microseconds - 4_000, camera.scale),
                )

            def _store(self, kind: str, data: bytes) -> UInt8Array:
                """The buffer of a kind of frame, which holds the data until the next one."""
                buffer = self._buffers.setdefault(kind, np.empty(BUFFER, np.uint8))[: len(data)]
                buffer[:] = np.frombuffer(data, np.uint8)
                return buffer

        class AlignFilter:
            def __init__(self, *, align_to_stream: OBStreamType) -> None:
                assert align_to_stream is OBStreamType.COLOR_STREAM

            def set_config_value(self, arg0: str, arg1: float) -> None:
                camera.options[arg0] = arg1

            def process(self, arg0: FrameSet) -> FrameSet:
                return arg0

        out = ModuleType("pyorbbecsdk")
        for one in (Context, DeviceList, Config, Pipeline, AlignFilter, *_SHARED):
            setattr(out, one.__name__, one)
        return out


_SHARED: tuple[type[Any], ...] = (
    OBError,
    OBFormat,
    OBSensorType,
    OBStreamType,
    OBLogLevel,
    OBFrameAggregateOutputMode,
    OBCameraDistortionModel,
    OBCameraIntrinsic,
    OBCameraDistortion,
    VideoStreamProfile,
    StreamProfileList,
    ColorFrame,
    DepthFrame,
    FrameSet,
)
