"""Colour and depth images on disk, and PNG bytes."""

from __future__ import annotations

import zlib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from objectflow.errors import ReaderError
from objectflow.typing import UInt8Array


def read_color(path: Path) -> UInt8Array:
    """Read a colour image as (H, W, 3) uint8 RGB; grey is repeated, alpha dropped.

    Raises:
        ReaderError: the file is missing, broken, or looks like depth.
    """
    image = read_image(path)
    if image.dtype != np.uint8:
        raise ReaderError(
            f"{path}: a colour image has 8 bits a channel, this has {image.dtype.itemsize * 8}: "
            "are colour and depth swapped?"
        )
    if image.ndim == 2:
        image = np.repeat(image[..., None], 3, axis=2)
    return np.ascontiguousarray(image[..., 2::-1], dtype=np.uint8)


def read_depth(path: Path) -> NDArray[np.uint16]:
    """Read a depth image as (H, W) uint16, in the file's own units.

    Raises:
        ReaderError: the file is missing, broken, or is no 16-bit single-channel image.
    """
    image = read_image(path)
    if image.ndim != 2:
        raise ReaderError(
            f"{path}: a depth image has one channel, this has {image.shape[2]}: are colour and depth swapped?"
        )
    if image.dtype != np.uint16:
        raise ReaderError(
            f"{path}: a depth image has 16 bits a pixel, this has {image.dtype.itemsize * 8}: "
            "save raw depth, not a picture of it"
        )
    return np.asarray(image, dtype=np.uint16)


def read_image(path: Path) -> NDArray[Any]:
    """Read an image of any kind as OpenCV gives it: (H, W) or (H, W, 3 or 4), BGR.

    Raises:
        ReaderError: the file is missing, cut off or broken.
    """
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        raise ReaderError(f"{path}: no such file") from None
    except OSError as error:
        raise ReaderError(f"{path}: cannot be read: {error.strerror}") from error
    # Some versions of OpenCV fill the missing rows of a cut-off file and say nothing.
    if data.startswith(b"\x89PNG\r\n\x1a\n"):
        _check_png(data, path)
    if data.startswith(b"\xff\xd8") and data.rfind(b"\xff\xd9") < data.rfind(b"\xff\xda"):
        raise ReaderError(f"{path}: the JPEG is cut off: copy the file again")
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED) if data else None
    except cv2.error:
        image = None
    if image is None:
        raise ReaderError(f"{path}: not an image that can be decoded (PNG or JPEG expected)")
    if image.ndim == 3 and image.shape[2] not in (3, 4):
        raise ReaderError(f"{path}: an image with {image.shape[2]} channels is neither colour nor depth")
    return np.asarray(image)


def _check_png(data: bytes, path: Path) -> None:
    """Walk a PNG's chunks: OpenCV believes a damaged length and fills gigabytes before it finds out."""
    at = 8
    while at + 12 <= len(data):
        end = at + 12 + int.from_bytes(data[at : at + 4], "big")
        if end > len(data):
            break
        if zlib.crc32(data[at + 4 : end - 4]) != int.from_bytes(data[end - 4 : end], "big"):
            raise ReaderError(f"{path}: not an image that can be decoded: the PNG is damaged: copy the file again")
        if data[at + 4 : at + 8] == b"IEND":
            return
        at = end
    raise ReaderError(f"{path}: the PNG is cut off: copy the file again")
