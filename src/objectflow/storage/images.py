"""The PNG codec of data sets and results, 8 and 16 bit; colour is RGB in arrays, whatever order the codec uses."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from objectflow.errors import ReaderError, ResultError
from objectflow.storage.coded_images import PNG_START, check_complete


def decode_png(data: object, name: str, *, size: tuple[int, int]) -> NDArray[Any]:
    """Decode the PNG bytes of a data set: (H, W) or (H, W, 3) RGB, uint8 or uint16.

    Args:
        data: the bytes.
        name: of the image, for messages.
        size: (width, height) that the image must have. The header is compared before any memory is allocated.

    Raises:
        ReaderError: the bytes are no complete, undamaged PNG of this size.
    """
    if not isinstance(data, bytes) or not data.startswith(PNG_START) or data[12:16] != b"IHDR":
        raise ReaderError(f"{name} is not a PNG")
    found = (int.from_bytes(data[16:20], "big"), int.from_bytes(data[20:24], "big"))
    if found != size:
        raise ReaderError(f"{name} has {found[0]}x{found[1]} pixels, not the {size[0]}x{size[1]} of its camera")
    check_complete(data, name)
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
