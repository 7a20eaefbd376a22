"""Images on disk and PNG bytes, 8 and 16 bit; colour is RGB in arrays, whatever order the codec uses."""

from __future__ import annotations

import zlib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from objectflow.errors import ReaderError, ResultError
from objectflow.typing import UInt8Array

_PNG_START = b"\x89PNG\r\n\x1a\n"


def read_color(path: Path) -> UInt8Array:
    """Read a colour image as (H, W, 3) uint8 RGB; grey is repeated, alpha is dropped.

    Raises:
        ReaderError: the file is missing or broken, or looks like depth.
    """
    image = read_image(path)
    if image.dtype != np.uint8:
        raise ReaderError(
            f"{path}: a colour image has 8 bits per channel, this has {image.dtype.itemsize * 8}: "
            "are colour and depth swapped?"
        )
    if image.ndim == 2:
        image = np.repeat(image[..., None], 3, axis=2)
    return np.ascontiguousarray(image[..., :3], dtype=np.uint8)


def read_depth(path: Path) -> NDArray[np.uint16]:
    """Read a depth image as (H, W) uint16, in the units of the file.

    Raises:
        ReaderError: the file is missing or broken, or is no 16-bit single-channel image.
    """
    image = read_image(path)
    if image.ndim != 2:
        raise ReaderError(
            f"{path}: a depth image has one channel, this has {image.shape[2]}: are colour and depth swapped?"
        )
    if image.dtype != np.uint16:
        raise ReaderError(
            f"{path}: a depth image has 16 bits per pixel, this has {image.dtype.itemsize * 8}: "
            "save raw depth, not a picture of it"
        )
    return np.asarray(image, dtype=np.uint16)


def read_image(path: Path) -> NDArray[Any]:
    """Read an image file: (H, W) or (H, W, 3 or 4), RGB or RGBA, in the file's own bit depth.

    Raises:
        ReaderError: the file is missing, truncated or broken.
    """
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        raise ReaderError(f"{path}: no such file") from None
    except OSError as error:
        raise ReaderError(f"{path}: cannot be read: {error.strerror}") from error
    # Some versions of OpenCV fill the missing rows of a truncated file without an error.
    if data.startswith(_PNG_START):
        _check_png(data, path)
    if data.startswith(b"\xff\xd8") and data.rfind(b"\xff\xd9") < data.rfind(b"\xff\xda"):
        raise ReaderError(f"{path}: the JPEG is cut off: copy the file again")
    image = _decode(data)
    if image is None:
        raise ReaderError(f"{path}: not an image that can be decoded (PNG or JPEG expected)")
    if image.ndim == 3 and image.shape[2] not in (3, 4):
        raise ReaderError(f"{path}: an image with {image.shape[2]} channels is neither colour nor depth")
    return image


def decode_png(data: bytes, name: str) -> NDArray[Any]:
    """Decode the PNG bytes of a data set: (H, W) or (H, W, 3) RGB, uint8 or uint16.

    Args:
        data: the bytes. They are checked for truncation, but not for damage, which the hash of their file reveals.
        name: of the image, for messages.

    Raises:
        ReaderError: the bytes are no complete PNG.
    """
    # OpenCV fills the missing rows of a truncated PNG with zeros, without an error.
    if data[-8:-4] != b"IEND":
        raise ReaderError(f"{name} is not a complete PNG")
    image = _decode(data)
    if image is None:
        raise ReaderError(f"{name} cannot be decoded")
    return image


def encode_png(image: NDArray[Any], *, compression: int | None = None) -> bytes:
    """Encode an image as PNG bytes.

    Args:
        image: (H, W) uint8 or uint16, or (H, W, 3) uint8 RGB.
        compression: 0..9; None for the default of OpenCV.

    Raises:
        ResultError: the image cannot be encoded.
    """
    options = [] if compression is None else [cv2.IMWRITE_PNG_COMPRESSION, compression]
    done, data = cv2.imencode(".png", _swap_red_and_blue(np.ascontiguousarray(image)), options)
    if not done:
        raise ResultError(f"an image of {image.shape[1]}x{image.shape[0]} pixels cannot be encoded as PNG")
    return bytes(data.tobytes())


def _decode(data: bytes) -> NDArray[Any] | None:
    """Decode an image of any format; None if that fails."""
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED) if data else None
        return None if image is None else _swap_red_and_blue(np.asarray(image))
    except cv2.error:
        return None


def _swap_red_and_blue(image: NDArray[Any]) -> NDArray[Any]:
    """Convert between RGB and the BGR of OpenCV, with or without alpha; other images are returned as they are."""
    codes = {3: cv2.COLOR_BGR2RGB, 4: cv2.COLOR_BGRA2RGBA}
    code = codes.get(image.shape[2]) if image.ndim == 3 else None
    return image if code is None else np.asarray(cv2.cvtColor(image, code))


def _check_png(data: bytes, path: Path) -> None:
    """Check the chunks of a PNG: OpenCV trusts a damaged length field and may allocate gigabytes."""
    at = len(_PNG_START)
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
