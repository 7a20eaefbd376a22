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
    openexr = _library()
    with foreign_errors(ReaderError, f"{path}: not an OpenEXR file that can be read"):
        low, high = openexr.File(str(path), header_only=True).header()["dataWindow"]
        return int(high[0]) - int(low[0]) + 1, int(high[1]) - int(low[1]) + 1


def read_exr(path: Path) -> NDArray[Any]:
    """Read the depth channel as (H, W) float16 or float32.

    A renderer may repeat depth in the channels R, G and B; R is read where there is no channel of another name.

    Raises:
        ReaderError: broken data, or no channel that may be depth.
        MissingExtraError: OpenEXR is not installed.
    """
    openexr = _library()
    with foreign_errors(ReaderError, f"{path}: not an OpenEXR file that can be read"):
        channels = openexr.File(str(path), separate_channels=True).channels()
        arrays = {name: np.asarray(channel.pixels) for name, channel in channels.items()}
    if len(arrays) == 1:
        return next(iter(arrays.values()))
    for wanted in DEPTH_CHANNELS:
        for name, array in arrays.items():
            if name.rpartition(".")[2] == wanted:
                return array
    raise ReaderError(f"{path}: no depth channel (Z, Y, V or R) among {', '.join(sorted(arrays)) or 'none'}")


def _library() -> Any:
    try:
        import OpenEXR
    except ImportError as error:
        raise MissingExtraError("OpenEXR files need OpenEXR", "exr") from error
    return OpenEXR
