"""A result on disk: `labels.png`, `scene_flow.npy` and `objects.json`."""

from __future__ import annotations

import io
import json
import tokenize
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from objectflow.errors import ReaderError, ResultError
from objectflow.storage.image_files import read_image
from objectflow.storage.images import encode_png
from objectflow.typing import Float32Array, LabelImage

# Errors that the parsers of JSON and .npy raise for broken files: unbounded numbers, unclosed brackets, headers that
# are not valid Python or request too much memory.
_BROKEN = (
    OSError,
    ValueError,
    LookupError,
    TypeError,
    EOFError,
    OverflowError,
    RecursionError,
    MemoryError,
    SyntaxError,
    tokenize.TokenError,
)


def write(folder: Path, labels: LabelImage, flow: Float32Array, summary: Mapping[str, Any]) -> None:
    """Write the three files into an existing folder.

    Raises:
        ResultError: labels that do not fit a 16-bit PNG.
    """
    if labels.max(initial=0) > np.iinfo(np.uint16).max:
        raise ResultError(f"{folder}: labels above 65535 do not fit a 16-bit PNG")
    (folder / "labels.png").write_bytes(encode_png(labels.astype(np.uint16)))
    # np.save writes to a file without the system's own error, such as "No space left on device".
    buffer = io.BytesIO()
    np.save(buffer, flow)
    (folder / "scene_flow.npy").write_bytes(buffer.getbuffer())
    (folder / "objects.json").write_text(json.dumps(summary, indent=2) + "\n")


def read(folder: Path) -> tuple[LabelImage, Float32Array, dict[str, Any]]:
    """Labels, flow and the content of `objects.json`; errors are those of the parsers, see `reading`."""
    summary = json.loads((folder / "objects.json").read_text(encoding="utf-8"))
    labels = read_image(folder / "labels.png")
    if labels.dtype.kind != "u":
        raise ValueError("labels.png must hold unsigned integers")
    if labels.shape != (summary["height"], summary["width"]):
        raise ValueError(f"labels.png has shape {labels.shape}, but objects.json states another size")
    with open(folder / "scene_flow.npy", "rb") as file:
        flow = np.lib.format.read_array(file, allow_pickle=False)
    return labels.astype(np.int32), flow, summary


@contextmanager
def reading(folder: Path) -> Iterator[None]:
    """Turn whatever a broken result makes the parsers raise into a `ResultError` of one line."""
    try:
        yield
    except FileNotFoundError as error:
        raise ResultError(f"{folder}: not a result folder: {Path(error.filename).name} is missing") from None
    except (ReaderError, ResultError) as error:
        raise ResultError(f"{folder}: not a result folder that can be read: {error}") from error
    except _BROKEN as error:
        reason = " ".join(f"{type(error).__name__}: {error}".split())[:200]
        raise ResultError(f"{folder}: not a result folder that can be read: {reason}") from error
