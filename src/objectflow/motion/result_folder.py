"""A result on disk: `labels.png`, `scene_flow.npy` and `objects.json`."""

from __future__ import annotations

import io
import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from objectflow.errors import ResultError
from objectflow.storage import files
from objectflow.storage.archives import npy_array
from objectflow.storage.foreign import located_errors
from objectflow.storage.image_files import read_image
from objectflow.storage.images import encode_png
from objectflow.typing import Float32Array, LabelImage


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
    summary = json.loads(files.read_bytes(folder / "objects.json"))
    labels = read_image(folder / "labels.png")
    if labels.dtype.kind != "u":
        raise ValueError("labels.png must hold unsigned integers")
    if labels.shape != (summary["height"], summary["width"]):
        raise ValueError(f"labels.png has shape {labels.shape}, but objects.json states another size")
    flow = npy_array(files.read_bytes(folder / "scene_flow.npy"))
    return labels.astype(np.int32), flow, summary


@contextmanager
def reading(folder: Path) -> Iterator[None]:
    """Turn whatever a broken result makes the parsers raise into a `ResultError` of one line."""
    where = f"{folder}: not a result folder that can be read"
    try:
        with located_errors(ResultError, where):
            yield
    except ResultError as error:
        if isinstance(error.__cause__, FileNotFoundError):
            name = Path(error.__cause__.filename).name
            raise ResultError(f"{folder}: not a result folder: {name} is missing") from None
        raise
