"""ROS image messages as arrays: raw images and the transports `compressed` and `compressedDepth`."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from objectflow.errors import ReaderError
from objectflow.readers.decoders import (
    COLOR_LAYOUTS,
    DEPTH_LAYOUTS,
    Layout,
    decode_coded,
    decode_rvl,
    raw_pixels,
    to_rgb8,
)
from objectflow.storage.coded_images import PNG_START
from objectflow.storage.foreign import foreign_errors
from objectflow.storage.image_files import to_metres
from objectflow.typing import Float32Array, UInt8Array

_DEPTH_WORDS = (*DEPTH_LAYOUTS, "mono16")
_DEPTH_HEADER = 12
"""Length in bytes of the header of compressedDepth: the format, and two parameters of quantised inverse depth."""


def is_depth(message: Any) -> bool | None:
    """Whether an image message holds depth according to its encoding, format or PNG header; None if it is no image.

    Two bytes per pixel with an 8-bit encoding count as depth, so that `to_depth` can report the wrong encoding.
    """
    if hasattr(message, "encoding"):
        return _encoding(message) in _DEPTH_WORDS or _is_mislabelled(message)
    if hasattr(message, "format"):
        kind = _format(message)
        start = bytes(message.data[:32])
        # A PNG states its bit depth and its colour type (0 = grey) after its size.
        is_grey16 = start.startswith(PNG_START) and start[24:26] == b"\x10\x00"
        return "compresseddepth" in kind or kind.split(";")[0] in _DEPTH_WORDS or is_grey16
    return None


def to_color(message: Any, topic: str) -> UInt8Array:
    """Decode an Image or CompressedImage message to (H, W, 3) uint8 RGB.

    Raises:
        ReaderError: the message is not a colour image or is broken.
    """
    if hasattr(message, "format"):
        return _coded_color(message, topic)
    encoding = _encoding(message)
    if encoding in DEPTH_LAYOUTS:
        raise ReaderError(f"{topic}: encoding {message.encoding} is depth, not colour: name another --color-topic")
    layout = COLOR_LAYOUTS.get(encoding)
    if layout is None:
        raise ReaderError(
            f"{topic}: image encoding {message.encoding!r} is not supported; supported: {', '.join(COLOR_LAYOUTS)}"
        )
    return to_rgb8(_pixels(message, layout, topic), layout.to_rgb)


def to_depth(
    message: Any, topic: str, depth_scale: float, float_depth_scale: float = 1.0, max_depth: float | None = None
) -> Float32Array:
    """Decode an Image or CompressedImage message to (H, W) float32 metres, 0 = missing.

    Args:
        message: 16-bit or floating-point depth; floating-point depth is in metres by REP 118.
        topic: for error messages.
        depth_scale: units per metre of integer depth.
        float_depth_scale: units per metre of floating-point depth.
        max_depth: depth beyond it is missing, metres; None for no limit.

    Raises:
        ReaderError: the message is not a depth image or is broken.
    """
    if hasattr(message, "format"):
        raw = _coded_depth(bytes(message.data), message, topic)
    elif _is_mislabelled(message):
        size = int(message.step) // int(message.width)
        raise ReaderError(
            f"{topic}: encoding {message.encoding} has 1 byte per pixel, but the rows have {size}: "
            "the encoding of 16-bit depth must be 16UC1"
        )
    else:
        encoding = _encoding(message)
        layout = DEPTH_LAYOUTS.get(encoding) or (COLOR_LAYOUTS["mono16"] if encoding == "mono16" else None)
        if layout is None:
            raise ReaderError(
                f"{topic}: encoding {message.encoding} is not depth (16UC1, 32FC1, 64FC1 or mono16): "
                "name another --depth-topic"
            )
        raw = _pixels(message, layout, topic)
    return to_metres(raw, depth_scale=depth_scale, float_depth_scale=float_depth_scale, max_depth=max_depth)


def _encoding(message: Any) -> str:
    return str(message.encoding).strip().lower()


def _format(message: Any) -> str:
    """The format of a CompressedImage without spaces, such as `16uc1;compresseddepthpng`."""
    return str(message.format).lower().replace(" ", "")


def _is_mislabelled(message: Any) -> bool:
    return _encoding(message) in ("mono8", "8uc1") and int(message.step) >= 2 * int(message.width) > 0


def _pixels(message: Any, layout: Layout, topic: str) -> NDArray[Any]:
    return raw_pixels(
        message.data,
        layout,
        width=int(message.width),
        height=int(message.height),
        step=int(message.step),
        big_endian=bool(message.is_bigendian),
        where=f"{topic} ({message.encoding})",
    )


def _coded_color(message: Any, topic: str) -> UInt8Array:
    where = f"{topic} ({message.format})"
    image = decode_coded(bytes(message.data), where)
    channels = 1 if image.ndim == 2 else image.shape[2]
    if image.dtype not in (np.uint8, np.uint16) or channels not in (1, 3, 4):
        raise ReaderError(f"{where}: {channels} channels of type {image.dtype} are not colour")
    source = COLOR_LAYOUTS.get(_format(message).split(";")[0])
    if channels == 1 and source is not None and source.channels == 1:
        # A Bayer pattern may be compressed as it is.
        return to_rgb8(image.reshape(image.shape[:2]), source.to_rgb)
    names = {1: "mono8", 3: "rgb8", 4: "rgba8"}
    return to_rgb8(image, COLOR_LAYOUTS[names[channels]].to_rgb)


def _coded_depth(data: bytes, message: Any, topic: str) -> NDArray[Any]:
    """Decode a 16-bit PNG, or the compressedDepth transport: a header, then a PNG or RVL.

    Floating-point depth in compressedDepth is stored as quantised inverse depth: `z = a / (value - b)`.
    """
    where, kind = f"{topic} ({message.format})", _format(message)
    if "rvl" in kind:
        image: NDArray[Any] = decode_rvl(data[_DEPTH_HEADER:], where)
    else:
        start = max(0, data.find(PNG_START, 0, 4 * _DEPTH_HEADER))
        image = decode_coded(data[start:], where)
        if image.ndim != 2 or image.dtype not in (np.uint16, np.float32):
            raise ReaderError(f"{where}: {image.dtype} of shape {image.shape} is not depth (16 bits, one channel)")
    if image.dtype != np.uint16 or not ("compresseddepth" in kind and "32fc1" in kind):
        return image
    with foreign_errors(ReaderError, f"{where}: the header of compressedDepth is missing"):
        a, b = struct.unpack_from("<ff", data, 4)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(image > 0, a / (image.astype(np.float32) - np.float32(b)), 0).astype(np.float32)
