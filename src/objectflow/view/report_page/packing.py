"""Compact encoding of images and numeric maps inside a page: WebP, and deflated differences in base64."""

from __future__ import annotations

import base64
import zlib

import cv2
import numpy as np
from numpy.typing import NDArray

from objectflow.errors import ResultError
from objectflow.typing import BoolMask, Float32Array, UInt8Array

NO_FLOW = -32768
"""Value that marks missing flow in maps of millimetres."""

_WEBP_QUALITY = 80


def pack_photo(image: UInt8Array) -> str:
    """(H, W, 3) uint8 RGB -> a data URI.

    Raises:
        ResultError: the image cannot be encoded.
    """
    done, data = cv2.imencode(
        ".webp", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_WEBP_QUALITY, _WEBP_QUALITY]
    )
    if not done:
        raise ResultError(f"a {image.shape[1]}x{image.shape[0]} picture cannot be encoded as WebP")
    return "data:image/webp;base64," + base64.b64encode(data.tobytes()).decode()


def pack_bytes(values: UInt8Array) -> str:
    """Encode uint8 values, such as labels, as deflated base64."""
    return base64.b64encode(zlib.compress(values.tobytes(), 9)).decode()


def pack_words(values: NDArray[np.int16]) -> str:
    """Encode int16 values as consecutive differences modulo 2^16, all low bytes before all high bytes.

    The differences of smooth maps are small and their high bytes mostly 0, so they deflate to a third of the size.
    """
    difference = np.diff(values.ravel().view(np.uint16), prepend=np.uint16(0)).astype("<u2")
    planes = difference.view(np.uint8).reshape(-1, 2).T
    return pack_bytes(np.ascontiguousarray(planes))


def millimetres(flow: Float32Array, valid: BoolMask) -> NDArray[np.int16]:
    """(H, W, 3) metres -> (3, H, W) integer millimetres, `NO_FLOW` where NaN.

    Pixels outside `valid` (H, W) are never shown; they repeat the preceding value, which deflates to nothing.
    """
    known = np.asarray(np.isfinite(flow).all(axis=-1), dtype=np.bool_)
    rounded = np.clip(np.rint(1000 * np.where(known[..., None], flow, 0)), NO_FLOW + 1, -NO_FLOW - 1)
    words = np.where(known[..., None], rounded, NO_FLOW).astype(np.int16).reshape(-1, 3)
    last = np.maximum.accumulate(np.where(valid.ravel(), np.arange(valid.size), 0))
    return np.ascontiguousarray(words[last].T).reshape(3, *valid.shape)
