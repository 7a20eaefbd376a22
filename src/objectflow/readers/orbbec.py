"""Frames of an Orbbec camera by the Orbbec SDK, version 2 (`pyorbbecsdk2`, imported as `pyorbbecsdk`)."""

from __future__ import annotations

import contextlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

from objectflow.errors import FrameError, ReaderError
from objectflow.geometry.camera import Camera
from objectflow.readers.camera_driver import TIMEOUT_MS, CameraDriver, CameraImages, StreamRequest, import_library
from objectflow.readers.camera_info import ImageCamera
from objectflow.readers.decoders import COLOR_LAYOUTS, DEPTH_LAYOUTS, Layout, decode_coded, raw_pixels, to_rgb8
from objectflow.readers.lens import make_lens
from objectflow.storage.foreign import located_errors
from objectflow.typing import UInt8Array

ob: Any = import_library("pyorbbecsdk", "Orbbec", "orbbec")

ENCODINGS = {
    "RGB": "rgb8",
    "BGR": "bgr8",
    "MJPG": "jpeg",
    "YUYV": "yuyv",
    "YUY2": "yuy2",
    "UYVY": "uyvy",
    "NV12": "nv12",
    "NV21": "nv21",
    "I420": "i420",
    "RGBA": "rgba8",
    "BGRA": "bgra8",
}
"""Encoding of each colour format of the SDK, in the order in which they are requested."""
BROWN_CONRADY = "k1", "k2", "p1", "p2", "k3"
"""Coefficients of the Brown-Conrady models in the order of OpenCV."""
DISTORTIONS: dict[str, tuple[str, tuple[str, ...]]] = {
    "NONE": ("none", ()),
    "BROWN_CONRADY": ("brown_conrady", BROWN_CONRADY),
    "BROWN_CONRADY_K6": ("rational_polynomial", (*BROWN_CONRADY, "k4", "k5", "k6")),
    "MODIFIED_BROWN_CONRADY": ("modified_brown_conrady", BROWN_CONRADY),
    "INVERSE_BROWN_CONRADY": ("inverse_brown_conrady", BROWN_CONRADY),
    "KANNALA_BRANDT4": ("fisheye", ("k1", "k2", "k3", "k4")),
}
"""Name of each distortion model of the SDK in `make_lens`, and its coefficients in order."""


class Orbbec(CameraDriver):
    """Cameras of the Gemini, Femto and Astra families, with the default size of the camera unless one is requested."""

    title = "Orbbec"
    # The SDK raises RuntimeError where no camera is connected.
    errors = (RuntimeError, ob.OBError)
    distorted = "color"

    def __init__(self) -> None:
        self._pipeline: Any = None

    def open(self, request: StreamRequest) -> None:
        """Start colour and depth."""
        # The SDK otherwise writes a folder `Log` into the working directory.
        ob.Context.set_logger_level(ob.OBLogLevel.NONE)
        if request.serial is None:
            pipeline = ob.Pipeline()
        else:
            pipeline = ob.Pipeline(ob.Context().query_devices().get_device_by_serial_number(request.serial))
        color = _color_profile(pipeline.get_stream_profile_list(ob.OBSensorType.COLOR_SENSOR), request)
        config = ob.Config()
        config.enable_stream(color)
        config.enable_stream(_depth_profile(pipeline.get_stream_profile_list(ob.OBSensorType.DEPTH_SENSOR), color))
        config.set_frame_aggregate_output_mode(ob.OBFrameAggregateOutputMode.FULL_FRAME_REQUIRE)
        with contextlib.suppress(ob.OBError):  # not every camera supports it
            pipeline.enable_frame_sync()
        self._align = ob.AlignFilter(align_to_stream=ob.OBStreamType.COLOR_STREAM)
        # Depth lies on the pixels of a pinhole camera then, and is not resampled a second time.
        self._align.set_config_value("TargetDistortion", 0)
        pipeline.start(config)
        self._pipeline = pipeline

    def read(self) -> CameraImages:
        """Wait for the next images."""
        frames = self._pipeline.wait_for_frames(TIMEOUT_MS)
        if frames is None:
            raise TimeoutError(f"no frame within {TIMEOUT_MS / 1000:g} s")
        aligned = self._align.process(frames)
        if aligned is None:
            raise FrameError("depth cannot be aligned to colour")
        found = aligned.as_frame_set()
        color, depth = found.get_color_frame(), found.get_depth_frame()
        if color is None or depth is None:
            raise FrameError("a set of frames lacks colour or depth")
        self._profile = color.get_stream_profile().as_video_stream_profile()
        # The SDK states millimetres per unit.
        scale = 1000 / float(depth.get_depth_scale())
        return CameraImages(
            _to_rgb(color), _raw_pixels(depth, DEPTH_LAYOUTS["16uc1"]), scale, seconds=color.get_timestamp_us() / 1e6
        )

    def camera(self) -> ImageCamera:
        """The camera model of the colour images."""
        K, lens = self._profile.get_intrinsic(), self._profile.get_distortion()
        model, names = DISTORTIONS.get(lens.model.name, (lens.model.name, BROWN_CONRADY))
        coefficients = tuple(float(getattr(lens, name)) for name in names)
        return ImageCamera(Camera(K.width, K.height, K.fx, K.fy, K.cx, K.cy), make_lens(model, coefficients))

    def close(self) -> None:
        """Stop the camera."""
        if self._pipeline is not None:
            self._pipeline.stop()


def _color_profile(profiles: Any, request: StreamRequest) -> Any:
    """The default of the camera, or the first profile of the requested size and rate that can be decoded."""
    default = profiles.get_default_video_stream_profile()
    if request.size is None and request.rate is None and default.get_format().name in ENCODINGS:
        return default
    width, height = request.size or (default.get_width(), default.get_height())
    for name in ENCODINGS:
        with contextlib.suppress(ob.OBError):  # the camera lacks this combination
            return profiles.get_video_stream_profile(width, height, getattr(ob.OBFormat, name), request.rate or 0)
    rate = "" if request.rate is None else f" at {request.rate} Hz"
    raise ReaderError(f"this Orbbec camera has no colour of {width}x{height}{rate}: try another size or rate")


def _depth_profile(profiles: Any, color: Any) -> Any:
    """The default of the camera, at the rate of colour if it is available."""
    default = profiles.get_default_video_stream_profile()
    if default.get_fps() != color.get_fps():
        with contextlib.suppress(ob.OBError):
            size = default.get_width(), default.get_height()
            return profiles.get_video_stream_profile(*size, default.get_format(), color.get_fps())
    return default


def _to_rgb(color: Any) -> UInt8Array:
    name = color.get_format().name
    encoding = ENCODINGS.get(name)
    if encoding is None:
        raise ReaderError(f"Orbbec colour in the format {name} is not supported: request another size")
    if encoding == "jpeg":
        with located_errors(FrameError, "damaged colour"):
            return to_rgb8(decode_coded(bytes(color.get_data()), f"Orbbec {name}"), None)
    layout = COLOR_LAYOUTS[encoding]
    return to_rgb8(_raw_pixels(color, layout), layout.to_rgb)


def _raw_pixels(frame: Any, layout: Layout) -> NDArray[Any]:
    """The values of a frame, copied because the SDK reuses its buffers."""
    width, height = frame.get_width(), frame.get_height()
    step = width * layout.channels * np.dtype(layout.dtype).itemsize
    with located_errors(FrameError, "damaged image"):
        return raw_pixels(
            bytes(frame.get_data()),
            layout,
            width=width,
            height=height,
            step=step,
            big_endian=False,
            where=f"Orbbec {frame.get_format().name}",
        )
