"""Depth in OpenEXR files, as renderers and Record3D write it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from objectflow.errors import MissingExtraError, ReaderError
from objectflow.storage.foreign import foreign_errors

DEPTH_CHANNELS = ("Z", "Depth", "depth", "Y", "V", "R")
"""Names of the depth channel, in order of preference; the part before the last dot is the name of a layer."""


def is_exr(data: bytes) -> bool:
    """Whether data start like an OpenEXR file."""
    return data.startswith(b"\x76\x2f\x31\x01")


def exr_size(path: Path) -> tuple[int, int]:
    """The (width, height) of the data window, from the header.

    Raises:
        ReaderError: a broken header.
        MissingExtraError: OpenEXR is not installed.
    """
    with foreign_errors(ReaderError, f"{path}: not an OpenEXR file that can be read"):
        return _window(_read_header(path))


def read_exr(path: Path) -> NDArray[Any]:
    """Read the depth channel as (H, W) float16 or float32.

    A renderer may repeat depth in the channels R, G and B; R is read where there is no channel of another name.

    Raises:
        ReaderError: broken data, or no channel that may be depth.
        MissingExtraError: OpenEXR is not installed.
    """
    with foreign_errors(ReaderError, f"{path}: not an OpenEXR file that can be read"):
        # `File` reports a damaged header, which crashes the header of `InputFile`; `InputFile` raises an error where
        # pixels are damaged, which `File` prints to standard output.
        header = _read_header(path)
        width, height = _window(header)
        name = _depth_channel([channel.name for channel in header["channels"]], path)
        stored = _library().InputFile(str(path)).channel(name)
        kind = np.float16 if len(stored) == 2 * width * height else np.float32
        return np.frombuffer(stored, kind).reshape(height, width)


def _read_header(path: Path) -> dict[str, Any]:
    header: dict[str, Any] = _library().File(str(path), header_only=True).header()
    return header


def _window(header: dict[str, Any]) -> tuple[int, int]:
    low, high = header["dataWindow"]
    return int(high[0]) - int(low[0]) + 1, int(high[1]) - int(low[1]) + 1


def _depth_channel(names: list[str], path: Path) -> str:
    if len(names) == 1:
        return names[0]
    for wanted in DEPTH_CHANNELS:
        for name in names:
            if name.rpartition(".")[2] == wanted:
                return name
    raise ReaderError(f"{path}: no depth channel (Z, Y, V or R) among {', '.join(sorted(names)) or 'none'}")


def _library() -> Any:
    try:
        import OpenEXR
    except ImportError as error:
        raise MissingExtraError("OpenEXR files need OpenEXR", "exr") from error
    return OpenEXR
