"""Images in the formats of OpenCV: PNG, JPEG, TIFF, WebP, BMP and the PNM family (PGM, PPM, PFM)."""

from __future__ import annotations

import warnings
import zlib
from pathlib import Path
from typing import IO, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from objectflow.errors import ReaderError
from objectflow.geometry.camera import MAX_IMAGE_BYTES, MAX_PIXELS
from objectflow.storage.foreign import foreign_errors

PNG_START = b"\x89PNG\r\n\x1a\n"
_HEADERS = ("PNG", "JPEG", "WEBP", "BMP", "PPM")
"""Formats whose header is read, by their names in Pillow."""
_TIFF_STARTS = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
"""First bytes of a TIFF and of a BigTIFF, of both byte orders."""


def coded_size(file: IO[bytes], path: Path) -> tuple[int, int]:
    """The (width, height) of an image, from its header.

    Raises:
        ReaderError: no header of a known format.
    """
    # Imported when an image is read, since Pillow takes longer to import than a wrong path to be refused.
    from PIL import Image, UnidentifiedImageError

    with foreign_errors(ReaderError, f"{path}: not an image that can be decoded"):
        if file.read(4) in _TIFF_STARTS:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # damaged tags that are not needed
                return _tiff_size(file, path)
        file.seek(0)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # damaged metadata that is not needed
                with Image.open(file, formats=_HEADERS) as image:
                    return image.size
        except Image.DecompressionBombError:
            raise ReaderError(f"{path}: too many pixels (at most {MAX_PIXELS // 1_000_000} megapixels)") from None
        except UnidentifiedImageError:
            raise ReaderError(
                f"{path}: not an image that can be decoded (PNG, JPEG, TIFF, EXR, NPY, NPZ, PGM, PPM, PFM, WebP or "
                "BMP expected)"
            ) from None


def _tiff_size(file: IO[bytes], path: Path) -> tuple[int, int]:
    """The (width, height) of a TIFF; `Image.open` refuses pixel types that OpenCV decodes, such as float64."""
    from PIL import TiffImagePlugin

    file.seek(0)
    header = file.read(8)
    directory = TiffImagePlugin.ImageFileDirectory_v2(header + (file.read(8) if header[2:3] == b"+" else b""))
    file.seek(directory.next)
    directory.load(file)
    width, height = int(directory[TiffImagePlugin.IMAGEWIDTH]), int(directory[TiffImagePlugin.IMAGELENGTH])
    bits = max(directory.get(TiffImagePlugin.BITSPERSAMPLE, (1,))) * directory.get(TiffImagePlugin.SAMPLESPERPIXEL, 1)
    # An image of too many pixels is refused by the caller, with their number.
    if min(width * height, MAX_PIXELS) * bits > 8 * MAX_IMAGE_BYTES:
        raise ReaderError(f"{path}: too large for an image (at most {MAX_IMAGE_BYTES // 1_000_000} MB)")
    return width, height


def check_complete(data: bytes, path: Path | str) -> None:
    """Check that a PNG or a JPEG is complete: some versions of OpenCV fill missing rows without an error.

    Raises:
        ReaderError: the file is cut off or damaged.
    """
    if data.startswith(PNG_START):
        _check_png(data, path)
    if data.startswith(b"\xff\xd8") and data.rfind(b"\xff\xd9") < data.rfind(b"\xff\xda"):
        raise ReaderError(f"{path}: the JPEG is cut off: copy the file again")


def decode(data: bytes, path: Path) -> NDArray[Any]:
    """Decode an image: (H, W) or (H, W, 3 or 4), RGB or RGBA, in the type of the file.

    Raises:
        ReaderError: the data are broken.
    """
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        image = None
    if image is None:
        raise ReaderError(f"{path}: not an image that can be decoded: the file is damaged: copy the file again")
    if image.ndim == 3 and image.shape[2] not in (1, 3, 4):
        raise ReaderError(f"{path}: an image with {image.shape[2]} channels is neither colour nor depth")
    if image.ndim == 3 and image.shape[2] >= 3:
        code = cv2.COLOR_BGR2RGB if image.shape[2] == 3 else cv2.COLOR_BGRA2RGBA
        # cvtColor does not support every type of a TIFF.
        image = cv2.cvtColor(image, code) if image.dtype in (np.uint8, np.uint16, np.float32) else image[..., 2::-1]
    return np.asarray(image)


def _check_png(data: bytes, path: Path | str) -> None:
    """Check the chunks of a PNG: OpenCV trusts a damaged length field and may allocate gigabytes."""
    at = len(PNG_START)
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
