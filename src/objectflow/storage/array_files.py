"""Images stored as NumPy arrays: NPY and NPZ files, without pickles."""

from __future__ import annotations

import io
import math
import zipfile
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from objectflow.errors import ReaderError
from objectflow.geometry.camera import MAX_IMAGE_BYTES, MAX_PIXELS
from objectflow.storage.archives import npy_header
from objectflow.storage.foreign import foreign_errors

MAX_HEADER_BYTES = 1 << 16
"""Longest header of an NPY file, in bytes."""


def is_npy(data: bytes) -> bool:
    """Whether data start like an NPY file."""
    return data.startswith(b"\x93NUMPY")


def is_npz(data: bytes) -> bool:
    """Whether data start like an NPZ file, which is a ZIP archive."""
    return data.startswith(b"PK\x03\x04")


def npy_size(file: IO[bytes], path: Path) -> tuple[int, int]:
    """The (width, height) of an image in an NPY file, from its header.

    Raises:
        ReaderError: a broken header, or an array that is not an image of numbers.
    """
    with foreign_errors(ReaderError, f"{path}: not an NPY file that can be read"):
        shape, _, dtype = npy_header(file)
    _check_array(shape, dtype, path)
    height, width = image_shape(shape)[:2]
    return width, height


def npz_size(file: IO[bytes], path: Path, names: tuple[str, ...]) -> tuple[int, int]:
    """The (width, height) of the image in an NPZ file; see `npy_size` and `decode_npz`."""
    with (
        foreign_errors(ReaderError, f"{path}: not an NPZ file that can be read"),
        zipfile.ZipFile(file) as archive,
        archive.open(_member(archive, path, names)) as member,
    ):
        return npy_size(member, path)


def decode_npy(data: bytes, path: Path) -> NDArray[Any]:
    """Decode an NPY file: (H, W) or (H, W, C), in native byte order.

    Raises:
        ReaderError: broken data, or an array that is not an image of numbers.
    """
    with foreign_errors(ReaderError, f"{path}: not an NPY file that can be read"):
        file = io.BytesIO(data)
        shape, fortran, stored = npy_header(file)
        _check_array(shape, stored, path)
        array = np.frombuffer(data, stored, math.prod(shape), file.tell())
        array = array.reshape(shape, order="F" if fortran else "C")
    return np.array(array.reshape(image_shape(shape)), dtype=stored.newbyteorder("="), order="C")


def decode_npz(data: bytes, path: Path, names: tuple[str, ...]) -> NDArray[Any]:
    """Decode an NPZ file that holds one array, or one with the first of `names` that is present.

    Raises:
        ReaderError: broken data, several arrays without such a name, or an array that is not an image of numbers.
    """
    with (
        foreign_errors(ReaderError, f"{path}: not an NPZ file that can be read"),
        zipfile.ZipFile(io.BytesIO(data)) as archive,
        archive.open(_member(archive, path, names)) as member,
    ):
        npy_size(member, path)  # checks the size that the header declares; a longer member is not read beyond it
        member.seek(0)
        return decode_npy(member.read(MAX_IMAGE_BYTES + MAX_HEADER_BYTES), path)


def image_shape(shape: tuple[int, ...]) -> tuple[int, ...]:
    """The shape of an image without the leading 1 of a batch or channel axis."""
    return shape[1:] if len(shape) == 3 and shape[0] == 1 else shape


def _member(archive: zipfile.ZipFile, path: Path, names: tuple[str, ...]) -> str:
    arrays = [name for name in archive.namelist() if name.endswith(".npy")]
    if len(arrays) == 1:
        return arrays[0]
    for name in names:
        if f"{name}.npy" in arrays:
            return f"{name}.npy"
    found = ", ".join(name.removesuffix(".npy") for name in arrays[:8]) or "none"
    raise ReaderError(f"{path}: an NPZ file of an image holds one array, or one named {names[0]}; this has {found}")


def _check_array(shape: tuple[int, ...], dtype: np.dtype[Any], path: Path) -> None:
    if dtype.kind not in "uif":
        raise ReaderError(f"{path}: an image holds integers or floating-point numbers, not {dtype}")
    image = image_shape(shape)
    if len(image) not in (2, 3) or (len(image) == 3 and image[2] not in (1, 3, 4)):
        raise ReaderError(f"{path}: an array of shape {shape} is neither a colour nor a depth image")
    # An image of too many pixels is refused by its caller, with their number.
    if min(math.prod(image[:2]), MAX_PIXELS) * math.prod(image[2:]) * dtype.itemsize > MAX_IMAGE_BYTES:
        raise ReaderError(
            f"{path}: too large for an image: {shape} {dtype} (at most {MAX_IMAGE_BYTES // 1_000_000} MB)"
        )
