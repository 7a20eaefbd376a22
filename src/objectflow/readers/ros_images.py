"""ROS image messages as arrays: raw, `compressed` and `compressedDepth`."""

from __future__ import annotations

import struct
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from objectflow.errors import ReaderError
from objectflow.typing import Float32Array, UInt8Array

_DEPTH = {"16uc1", "mono16", "32fc1"}
_LAYOUTS: dict[str, tuple[type[np.generic], int, int | None]] = {
    "rgb8": (np.uint8, 3, None),
    "bgr8": (np.uint8, 3, cv2.COLOR_BGR2RGB),
    "8uc3": (np.uint8, 3, cv2.COLOR_BGR2RGB),
    "rgba8": (np.uint8, 4, cv2.COLOR_RGBA2RGB),
    "bgra8": (np.uint8, 4, cv2.COLOR_BGRA2RGB),
    "8uc4": (np.uint8, 4, cv2.COLOR_BGRA2RGB),
    "mono8": (np.uint8, 1, cv2.COLOR_GRAY2RGB),
    "8uc1": (np.uint8, 1, cv2.COLOR_GRAY2RGB),
    "bayer_rggb8": (np.uint8, 1, cv2.COLOR_BayerRGGB2RGB),
    "bayer_bggr8": (np.uint8, 1, cv2.COLOR_BayerBGGR2RGB),
    "bayer_gbrg8": (np.uint8, 1, cv2.COLOR_BayerGBRG2RGB),
    "bayer_grbg8": (np.uint8, 1, cv2.COLOR_BayerGRBG2RGB),
    "16uc1": (np.uint16, 1, None),
    "mono16": (np.uint16, 1, None),
    "32fc1": (np.float32, 1, None),
}
_PNG = b"\x89PNG"


def is_depth(message: Any) -> bool | None:
    """Whether an image message holds depth according to its encoding or format; None if it is not an image.

    Two bytes per pixel with an 8-bit encoding count as depth, so that `to_depth` can report the wrong encoding.
    """
    if hasattr(message, "encoding"):
        return str(message.encoding).lower() in _DEPTH or _is_mislabelled(message)
    if hasattr(message, "format"):
        return "compresseddepth" in str(message.format).lower().replace(" ", "")
    return None


def to_color(message: Any, topic: str) -> UInt8Array:
    """Decode an Image or CompressedImage message to (H, W, 3) uint8 RGB.

    Raises:
        ReaderError: the message is not a colour image or is broken.
    """
    if hasattr(message, "format"):
        image = cv2.imdecode(np.frombuffer(bytes(message.data), np.uint8), cv2.IMREAD_COLOR)
        if image is None:
            raise ReaderError(f"{topic}: an image in format {message.format!r} cannot be decoded")
        return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), dtype=np.uint8)
    encoding = str(message.encoding).lower()
    if encoding in _DEPTH:
        raise ReaderError(f"{topic}: encoding {message.encoding} is depth, not colour: name another --color-topic")
    pixels, conversion = _pixels(message, topic)
    return np.ascontiguousarray(pixels if conversion is None else cv2.cvtColor(pixels, conversion), dtype=np.uint8)


def to_depth(message: Any, topic: str, depth_scale: float) -> Float32Array:
    """Decode an Image or compressedDepth message to (H, W) float32 metres, 0 = missing.

    Args:
        message: integer depth is in units of 1 / `depth_scale` metres; floating-point depth is in metres (REP 118).
        topic: for error messages.
        depth_scale: units per metre.

    Raises:
        ReaderError: the message is not a depth image or is broken.
    """
    if hasattr(message, "format"):
        raw = _decompress_depth(bytes(message.data), str(message.format), topic)
    elif _is_mislabelled(message):
        size = int(message.step) // int(message.width)
        raise ReaderError(
            f"{topic}: encoding {message.encoding} has 1 byte per pixel, but the rows have {size}: "
            "the encoding of 16-bit depth must be 16UC1"
        )
    elif str(message.encoding).lower() not in _DEPTH:
        raise ReaderError(
            f"{topic}: encoding {message.encoding} is not depth (16UC1, mono16 or 32FC1): name another --depth-topic"
        )
    else:
        raw = _pixels(message, topic)[0]
    if raw.dtype == np.uint16:
        return np.asarray(raw / np.float32(depth_scale), dtype=np.float32)
    metres = np.asarray(raw, dtype=np.float32)
    return np.where(np.isfinite(metres) & (metres > 0), metres, np.float32(0))


def _is_mislabelled(message: Any) -> bool:
    return str(message.encoding).lower() in ("mono8", "8uc1") and int(message.step) >= 2 * int(message.width) > 0


def _pixels(message: Any, topic: str) -> tuple[NDArray[Any], int | None]:
    """The array of a raw image, and the OpenCV conversion to RGB."""
    encoding = str(message.encoding).lower()
    if encoding not in _LAYOUTS:
        raise ReaderError(
            f"{topic}: image encoding {message.encoding!r} is not supported; supported: {', '.join(_LAYOUTS)}"
        )
    kind, channels, conversion = _LAYOUTS[encoding]
    height, width, step = int(message.height), int(message.width), int(message.step)
    row = width * channels * np.dtype(kind).itemsize
    data = np.frombuffer(bytes(message.data), np.uint8)
    if height < 1 or width < 1 or step < row or len(data) < height * step:
        raise ReaderError(
            f"{topic}: an image of {width}x{height} {message.encoding} with rows of {step} bytes is broken"
        )
    layout = np.dtype(kind).newbyteorder(">" if int(message.is_bigendian) else "<")
    rows = np.ascontiguousarray(data[: height * step].reshape(height, step)[:, :row])
    pixels = rows.view(layout).astype(kind)
    return pixels.reshape((height, width, channels) if channels > 1 else (height, width)), conversion


def _decompress_depth(data: bytes, kind: str, topic: str) -> NDArray[Any]:
    """Decode the compressedDepth transport: a 12-byte header (format, a, b), then a 16-bit PNG.

    Floating-point depth is stored as quantised inverse depth: `z = a / (value - b)`.
    """
    start = data.find(_PNG)
    if start < 0:
        raise ReaderError(f"{topic}: depth in format {kind!r} holds no PNG: only PNG compression is supported")
    image = cv2.imdecode(np.frombuffer(data[start:], np.uint8), cv2.IMREAD_UNCHANGED)
    if image is None or image.dtype != np.uint16 or image.ndim != 2:
        raise ReaderError(f"{topic}: depth in format {kind!r} is not a 16-bit PNG")
    if "32fc1" not in kind.lower():
        return np.asarray(image)
    if start < 12:
        raise ReaderError(f"{topic}: depth in format {kind!r} lacks the compressedDepth header")
    a, b = struct.unpack("<ff", data[start - 8 : start])
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(image > 0, a / (image.astype(np.float32) - b), 0).astype(np.float32)
