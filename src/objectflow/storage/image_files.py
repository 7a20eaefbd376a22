"""Colour and depth images in every file format that the readers know: one table for all layouts.

| format | colour | depth |
|---|---|---|
| PNG, TIFF, PGM/PPM | 8 or 16 bits per channel | 16-bit integers; TIFF also floating point |
| JPEG, WebP, BMP | 8 bits per channel | refused: lossy or 8 bits |
| PFM, OpenEXR | refused | floating point |
| NPY, NPZ | uint8 or uint16 | integers of 16 bits or more, or floating point |

The format is recognised by the content of a file, not by its suffix. The size is read from the header before anything
is decoded.
"""

from __future__ import annotations

import io
import stat
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from objectflow.errors import ReaderError
from objectflow.geometry.camera import MAX_PIXELS
from objectflow.storage import array_files, coded_images, exr_files
from objectflow.storage.foreign import foreign_errors
from objectflow.typing import Float32Array, UInt8Array

IMAGE_SUFFIXES = frozenset(
    {".png", ".jpg", ".jpeg", ".tif", ".tiff", ".exr", ".npy", ".npz", ".pgm", ".ppm", ".pnm", ".pfm", ".webp", ".bmp"}
)
"""Suffixes of image files, in lower case; the suffixes of files may have any case."""
MAX_FILE_BYTES = 1 << 30
"""Largest image file that is read, in bytes."""
DEPTH_NAMES = ("depth", "depth_map", "z", "arr_0")
"""Names of the depth array in an NPZ file that holds several arrays."""
COLOR_NAMES = ("color", "colour", "rgb", "image", "arr_0")
"""Names of the colour array in an NPZ file that holds several arrays."""


def is_image(path: Path) -> bool:
    """Whether a path is a regular file with the suffix of an image; pipes and devices are not."""
    return path.suffix.lower() in IMAGE_SUFFIXES and path.is_file()


def read_size(path: Path) -> tuple[int, int]:
    """Read the (width, height) of an image from its header.

    Raises:
        ReaderError: the file is missing, empty, not an image, or larger than `MAX_PIXELS`.
    """
    with _open(path) as file:
        start = file.read(16)
        file.seek(0)
        if array_files.is_npy(start):
            size = array_files.npy_size(file, path)
        elif array_files.is_npz(start):
            size = array_files.npz_size(file, path, DEPTH_NAMES + COLOR_NAMES)
        elif exr_files.is_exr(start):
            size = exr_files.exr_size(path)
        else:
            size = coded_images.coded_size(file, path)
    check_pixels(size, path)
    return size


def read_color(path: Path) -> UInt8Array:
    """Read a colour image as (H, W, 3) uint8 RGB; grey is repeated, alpha is dropped and 16 bits become 8.

    Raises:
        ReaderError: the file is missing, broken or too large, or looks like depth.
    """
    image = read_image(path, names=COLOR_NAMES)
    if image.dtype == np.uint16 and image.ndim == 3 and image.shape[2] >= 3:
        image = (image >> 8).astype(np.uint8)
    if image.dtype != np.uint8:
        raise ReaderError(
            f"{path}: a colour image has 8 bits per channel, this has {image.dtype.itemsize * 8}: "
            "are colour and depth swapped?"
        )
    if image.ndim == 2 or image.shape[2] == 1:
        image = np.repeat(image.reshape(*image.shape[:2], 1), 3, axis=2)
    return np.ascontiguousarray(image[..., :3], dtype=np.uint8)


def read_photograph(path: Path) -> UInt8Array:
    """Read an image that belongs to no depth as (H, W, 3) uint8 RGB, turned as its EXIF orientation states.

    Raises:
        ReaderError: the file is missing, broken or too large.
    """
    read_size(path)
    with foreign_errors(ReaderError, f"{path}: not an image that can be decoded"):
        image = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if image is None:
        raise ReaderError(f"{path}: not an image that can be decoded")
    return np.ascontiguousarray(image[..., ::-1], dtype=np.uint8)


def read_depth(path: Path) -> NDArray[Any]:
    """Read a depth image as an (H, W) array of integers or floating-point numbers, in the units of the file.

    Raises:
        ReaderError: the file is missing, broken or too large, has several channels or fewer than 16 bits per pixel.
    """
    image = read_image(path, names=DEPTH_NAMES)
    if image.ndim == 3 and image.shape[2] == 1:
        image = image[..., 0]
    if image.ndim != 2:
        raise ReaderError(
            f"{path}: a depth image has one channel, this has {image.shape[2]}: are colour and depth swapped?"
        )
    if image.dtype.itemsize < 2:
        raise ReaderError(
            f"{path}: a depth image has 16 bits per pixel, this has {image.dtype.itemsize * 8}: "
            "save raw depth, not a picture of it"
        )
    return image


def to_metres(
    depth: NDArray[Any], *, depth_scale: float = 1000.0, float_depth_scale: float = 1.0, max_depth: float | None = None
) -> Float32Array:
    """Convert stored depth to metres, with 0 where it is missing.

    Args:
        depth: (H, W) integers or floating-point numbers. The largest value of the type, values that are not finite and
            values of 0 and below are missing.
        depth_scale: units per metre of integers.
        float_depth_scale: units per metre of floating-point numbers.
        max_depth: depth beyond it is missing, metres; None for no limit.

    Returns:
        (H, W) float32. A scale that makes depth infinite or 0 is reported by `RgbdFrame`.
    """
    floating = depth.dtype.kind == "f"
    largest = np.finfo(depth.dtype).max if floating else np.iinfo(depth.dtype).max
    with np.errstate(all="ignore"):
        missing = ~(depth > 0) | (depth == largest)
        if floating:
            missing |= np.isinf(depth)
        # Wide types are scaled before the cast, because large integers and doubles may not fit float32.
        scale = np.float32(float_depth_scale if floating else depth_scale)
        wide: NDArray[Any] = depth.astype(np.float64 if depth.dtype.itemsize > 4 else np.float32)
        metres: Float32Array = (wide / scale).astype(np.float32)
    metres[missing] = 0
    if max_depth is not None:
        metres[metres > max_depth] = 0
    return metres


def read_image(path: Path, *, names: tuple[str, ...] = ()) -> NDArray[Any]:
    """Read an image file: (H, W) or (H, W, C), RGB or RGBA, in the file's own type.

    Args:
        path: the file.
        names: preferred arrays of an NPZ file that holds several.

    Raises:
        ReaderError: the file is missing, truncated, broken or too large.
    """
    with _open(path) as file:
        data = file.read()
    if array_files.is_npy(data):
        size = array_files.npy_size(io.BytesIO(data), path)
        check_pixels(size, path)
        return array_files.decode_npy(data, path)
    if array_files.is_npz(data):
        check_pixels(array_files.npz_size(io.BytesIO(data), path, names), path)
        return array_files.decode_npz(data, path, names)
    if exr_files.is_exr(data):
        check_pixels(exr_files.exr_size(path), path)
        return exr_files.read_exr(path)
    coded_images.check_complete(data, path)
    check_pixels(coded_images.coded_size(io.BytesIO(data), path), path)
    return coded_images.decode(data, path)


def _open(path: Path) -> io.BufferedReader:
    """Open a regular file; opening a pipe would wait for its writer, and a device has no end."""
    try:
        status = path.stat()
        if not stat.S_ISREG(status.st_mode):
            raise ReaderError(f"{path}: cannot be read: it is not a regular file")
        if status.st_size > MAX_FILE_BYTES:
            raise ReaderError(f"{path}: {status.st_size / 1e9:.1f} GB are too large for an image")
        if status.st_size == 0:
            raise ReaderError(f"{path}: not an image: the file is empty")
        return open(path, "rb")
    except FileNotFoundError:
        raise ReaderError(f"{path}: no such file") from None
    except ValueError as error:  # a path with a null byte
        raise ReaderError(f"{path}: cannot be read: {error}") from error
    except OSError as error:
        raise ReaderError(f"{path}: cannot be read: {error.strerror}") from error


def check_pixels(size: tuple[int, int], path: Path) -> None:
    """Check the size of an image before it is decoded.

    Args:
        size: (width, height) in pixels.
        path: of the image, for messages.

    Raises:
        ReaderError: the image has no pixels or more than `MAX_PIXELS`.
    """
    width, height = size
    if width < 1 or height < 1:
        raise ReaderError(f"{path}: an image of {width}x{height} pixels has no content")
    if width * height > MAX_PIXELS:
        raise ReaderError(
            f"{path}: {width}x{height} pixels are too many (at most {MAX_PIXELS // 1_000_000} megapixels)"
        )
