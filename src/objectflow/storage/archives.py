"""NumPy arrays and archives from disk: the declared sizes are checked before memory is allocated."""

from __future__ import annotations

import io
import math
import warnings
import zipfile
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from objectflow.errors import DatasetError
from objectflow.storage import files
from objectflow.storage.foreign import foreign_errors

MAX_ARCHIVE_BYTES = 1 << 29
"""Largest content of an archive that is read, in bytes, all arrays together."""


def read_archive(path: Path) -> dict[str, NDArray[Any]]:
    """All arrays of an `.npz` file.

    Raises:
        DatasetError: a file that cannot be read, or arrays of more than `MAX_ARCHIVE_BYTES`.
    """
    with (
        foreign_errors(DatasetError, f"{path}: not a NumPy archive that can be read"),
        zipfile.ZipFile(io.BytesIO(files.read_bytes(path, MAX_ARCHIVE_BYTES))) as archive,
    ):
        members = archive.infolist()
        # A member is never read beyond the size that its record states.
        total = sum(member.file_size for member in members)
        if total > MAX_ARCHIVE_BYTES:
            raise DatasetError(f"{path}: its arrays have {total} bytes, more than {MAX_ARCHIVE_BYTES}")
        return {member.filename.removesuffix(".npy"): npy_array(archive.read(member)) for member in members}


def npy_header(file: IO[bytes]) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    """The shape of the array in an `.npy` file, whether its order is Fortran's, and its type; the data follow.

    Raises:
        ValueError: a broken header.
    """
    version = np.lib.format.read_magic(file)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # NumPy advises to rewrite files from Python 2
        shape, fortran, dtype = read(file)
    return shape, fortran, dtype


def npy_array(data: bytes) -> NDArray[Any]:
    """Decode the bytes of an `.npy` file.

    Raises:
        ValueError: the header is broken, declares Python objects, or another size than the data have.
    """
    file = io.BytesIO(data)
    shape, fortran, dtype = npy_header(file)
    count, start = math.prod(shape), file.tell()
    if dtype.hasobject:
        raise ValueError("an array of Python objects, which is a pickle")
    if min(shape, default=0) < 0 or count * dtype.itemsize != len(data) - start:
        raise ValueError(f"its header declares {shape} {dtype}, but {len(data) - start} bytes follow")
    flat = np.frombuffer(data, dtype, count, start).copy() if count else np.empty(0, dtype)
    return flat.reshape(shape, order="F" if fortran else "C")
