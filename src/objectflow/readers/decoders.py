"""The image encodings of ROS in one table, and the decoders of raw images, of coded images and of RVL depth.

Names are those of `sensor_msgs/image_encodings.h`, with the aliases that drivers write. Every size is checked against
the bytes that are there before anything is decoded.
"""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from objectflow.errors import ReaderError
from objectflow.storage import coded_images
from objectflow.storage.image_files import check_pixels
from objectflow.typing import UInt8Array


@dataclass(frozen=True)
class Layout:
    """Memory layout of a raw encoding.

    Attributes:
        dtype: of one value.
        channels: number of values per pixel in a row.
        to_rgb: OpenCV's conversion to RGB; None if the values are RGB or depth.
        rows: rows in memory per image row, times two: 3 for formats with subsampled colour planes.
    """

    dtype: type[np.generic]
    channels: int
    to_rgb: int | None = None
    rows: int = 2


DEPTH_LAYOUTS: dict[str, Layout] = {
    "16uc1": Layout(np.uint16, 1),
    "16sc1": Layout(np.int16, 1),
    "32fc1": Layout(np.float32, 1),
    "64fc1": Layout(np.float64, 1),
}
"""Encodings that are depth, in lower case; `mono16` is depth as well, unless it is chosen as colour."""

COLOR_LAYOUTS: dict[str, Layout] = {
    "rgb8": Layout(np.uint8, 3),
    "bgr8": Layout(np.uint8, 3, cv2.COLOR_BGR2RGB),
    "8uc3": Layout(np.uint8, 3, cv2.COLOR_BGR2RGB),
    "rgba8": Layout(np.uint8, 4, cv2.COLOR_RGBA2RGB),
    "bgra8": Layout(np.uint8, 4, cv2.COLOR_BGRA2RGB),
    "8uc4": Layout(np.uint8, 4, cv2.COLOR_BGRA2RGB),
    "mono8": Layout(np.uint8, 1, cv2.COLOR_GRAY2RGB),
    "8uc1": Layout(np.uint8, 1, cv2.COLOR_GRAY2RGB),
    "rgb16": Layout(np.uint16, 3),
    "bgr16": Layout(np.uint16, 3, cv2.COLOR_BGR2RGB),
    "16uc3": Layout(np.uint16, 3, cv2.COLOR_BGR2RGB),
    "rgba16": Layout(np.uint16, 4, cv2.COLOR_RGBA2RGB),
    "bgra16": Layout(np.uint16, 4, cv2.COLOR_BGRA2RGB),
    "16uc4": Layout(np.uint16, 4, cv2.COLOR_BGRA2RGB),
    "mono16": Layout(np.uint16, 1, cv2.COLOR_GRAY2RGB),
    **{
        f"bayer_{pattern.lower()}{bits}": Layout(dtype, 1, getattr(cv2, f"COLOR_Bayer{pattern}2RGB"))
        for pattern in ("RGGB", "BGGR", "GBRG", "GRBG")
        for bits, dtype in ((8, np.uint8), (16, np.uint16))
    },
    **dict.fromkeys(("yuv422", "uyvy"), Layout(np.uint8, 2, cv2.COLOR_YUV2RGB_UYVY)),
    **dict.fromkeys(("yuv422_yuy2", "yuyv", "yuy2"), Layout(np.uint8, 2, cv2.COLOR_YUV2RGB_YUYV)),
    "nv12": Layout(np.uint8, 1, cv2.COLOR_YUV2RGB_NV12, rows=3),
    "nv21": Layout(np.uint8, 1, cv2.COLOR_YUV2RGB_NV21, rows=3),
    **dict.fromkeys(("i420", "yuv420"), Layout(np.uint8, 1, cv2.COLOR_YUV2RGB_I420, rows=3)),
}
"""Encodings that are colour, in lower case."""


def raw_pixels(
    data: bytes, layout: Layout, *, width: int, height: int, step: int, big_endian: bool, where: str
) -> NDArray[Any]:
    """The values of a raw image: (H, W) or (H, W, C), or (3/2 H, W) with subsampled colour planes.

    Args:
        data: rows of `step` bytes; padding at the end of rows is dropped.
        layout: of the encoding.
        width, height: in pixels.
        step: length of a row in bytes.
        big_endian: byte order of values of more than one byte.
        where: topic and encoding, for error messages.

    Raises:
        ReaderError: the sizes do not fit the data, or the image has too many pixels.
    """
    itemsize = np.dtype(layout.dtype).itemsize
    row = width * layout.channels * itemsize
    rows = height * layout.rows // 2
    check_pixels((width, height), Path(where))
    if step < row or len(data) < rows * step:
        raise ReaderError(f"{where}: an image of {width}x{height} with rows of {step} bytes does not fit its data")
    if (layout.rows != 2 or layout.channels == 2) and (width % 2 or (layout.rows != 2 and height % 2)):
        raise ReaderError(f"{where}: an image of {width}x{height} cannot have colour at half the resolution")
    values = np.frombuffer(data, np.uint8, count=rows * step).reshape(rows, step)[:, :row]
    stored = np.dtype(layout.dtype).newbyteorder(">" if big_endian else "<")
    pixels = np.ascontiguousarray(values).view(stored).astype(layout.dtype, copy=False)
    return pixels.reshape(rows, width, layout.channels) if layout.channels > 1 else pixels.reshape(rows, width)


def to_rgb8(pixels: NDArray[Any], to_rgb: int | None) -> UInt8Array:
    """Convert the values of a colour encoding to (H, W, 3) uint8 RGB; 16-bit values keep their upper 8 bits."""
    image = pixels if to_rgb is None else np.asarray(cv2.cvtColor(pixels, to_rgb))
    if image.dtype == np.uint16:
        image = np.right_shift(image.astype(np.uint16, copy=False), 8)
    return np.ascontiguousarray(image, dtype=np.uint8)


def decode_coded(data: bytes, where: str) -> NDArray[Any]:
    """Decode a PNG, JPEG, WebP, TIFF or BMP: (H, W) or (H, W, 3 or 4), RGB or RGBA, in the type of the file.

    Raises:
        ReaderError: the data are broken or cut off, or the image has too many pixels.
    """
    name = Path(where)
    coded_images.check_complete(data, name)
    check_pixels(coded_images.coded_size(io.BytesIO(data), name), name)
    return coded_images.decode(data, name)


def decode_rvl(data: bytes, where: str) -> NDArray[np.uint16]:
    """Decode depth in RVL (run lengths of missing depth, and variable-length differences of the values between them).

    Source: A. D. Wilson, "Fast Lossless Depth Image Compression", ISS 2017. The compressedDepth transport precedes the
    stream with the width and the height, 32-bit little-endian integers.

    Returns:
        (H, W) uint16.

    Raises:
        ReaderError: the stream is broken or too short, or the image has too many pixels.
    """
    if len(data) < 8:
        raise ReaderError(f"{where}: depth in RVL lacks its size")
    width, height = (int(value) for value in np.frombuffer(data, "<i4", count=2))
    check_pixels((width, height), Path(where))
    count = width * height
    lengths, deltas = _rvl_runs(_rvl_values(data[8:], where), count, where)
    is_known = np.repeat(np.arange(len(lengths)) % 2 == 1, lengths)
    depth = np.zeros(count, np.int64)
    depth[: len(is_known)][is_known] = np.cumsum(deltas)
    return depth.astype(np.uint16).reshape(height, width)


def _rvl_values(data: bytes, where: str) -> NDArray[np.int64]:
    """The variable-length integers of a stream: groups of 3 bits, lowest first; the fourth bit announces another."""
    # Half-bytes are stored from the highest to the lowest in 32-bit little-endian words.
    words = np.frombuffer(data, "<u4", count=len(data) // 4)
    shifts = np.arange(28, -1, -4, dtype=np.uint32)
    nibbles = ((words[:, None] >> shifts) & 15).astype(np.int64).ravel()
    is_last = nibbles < 8
    nibbles = nibbles[: np.flatnonzero(is_last)[-1] + 1] if is_last.any() else nibbles[:0]
    starts = np.concatenate([[0], np.flatnonzero(is_last[: len(nibbles)])[:-1] + 1]) if len(nibbles) else nibbles
    place = np.arange(len(nibbles)) - np.repeat(starts, np.diff([*starts.tolist(), len(nibbles)]))
    if len(place) and place.max() > 10:
        raise ReaderError(f"{where}: depth in RVL is broken: a number has more than 32 bits")
    return np.add.reduceat((nibbles & 7) << (3 * place), starts) if len(nibbles) else nibbles


def _rvl_runs(values: NDArray[np.int64], count: int, where: str) -> tuple[list[int], NDArray[np.int64]]:
    """Alternating run lengths of missing and known depth, and the differences of consecutive known values."""
    lengths: list[int] = []
    parts: list[NDArray[np.int64]] = []
    position = filled = 0
    while filled < count:
        if position + 2 > len(values):
            raise ReaderError(f"{where}: depth in RVL is cut off after {filled} of {count} pixels")
        missing, known = int(values[position]), int(values[position + 1])
        position += 2
        if filled + missing + known > count or position + known > len(values):
            raise ReaderError(f"{where}: depth in RVL is broken: its runs exceed the image")
        parts.append(values[position : position + known])
        lengths += [missing, known]
        filled += missing + known
        position += known
    coded = np.concatenate(parts) if parts else np.zeros(0, np.int64)
    return lengths, (coded >> 1) ^ -(coded & 1)
