"""Draw the first pairs of a data set as one image: `python scripts/contact_sheet.py data sheet.jpg`."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import tyro
from tyro.conf import Positional

from objectflow.dataset.moving_objects import moving_labels
from objectflow.dataset.schema import PairRow
from objectflow.dataset.shards import open_pairs
from objectflow.typing import LabelImage, UInt8Array
from objectflow.view.data_pictures import label_color


@dataclasses.dataclass
class Settings:
    """Draws previous and current frames side by side, in rows."""

    data: Positional[Path]
    """Folder of the data set."""
    out: Positional[Path]
    """Image to write."""
    split: str = "train"
    """Split of the set."""
    pairs: int = 40
    """Number of pairs."""
    columns: int = 5
    """Pairs per row."""
    width: int = 160
    """Width of each frame, pixels."""
    movers: bool = False
    """Outline moving objects in both frames."""


def outline(image: UInt8Array, labels: LabelImage, row: PairRow) -> UInt8Array:
    """Outline every moving object in an image; a white square in the corner marks a moving camera."""
    image = np.ascontiguousarray(image)
    size = (image.shape[1], image.shape[0])
    for label in sorted(moving_labels(row)):
        mask = cv2.resize((labels == label).astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)
        lines, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        cv2.drawContours(image, lines, -1, label_color(label), 1)
    if row.camera_motion is not None and not np.array_equal(row.camera_motion, np.eye(4)):
        cv2.rectangle(image, (2, 2), (8, 8), (255, 255, 255), -1)
        cv2.rectangle(image, (2, 2), (8, 8), (0, 0, 0), 1)
    return np.asarray(image, dtype=np.uint8)


def main(settings: Settings) -> None:
    """Read the pairs, downscale them, and draw them side by side."""
    rows = open_pairs(settings.data, settings.split)
    tiles = []
    for index in range(min(settings.pairs, len(rows))):
        row = rows[index]
        size = (settings.width, settings.width * row.curr.camera.height // row.curr.camera.width)
        frames = [
            np.asarray(cv2.resize(f.color, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
            for f in (row.prev, row.curr)
        ]
        if settings.movers:
            frames = [
                outline(f, labels, row) for f, labels in zip(frames, (row.prev_labels, row.curr_labels), strict=True)
            ]
        tiles.append(cv2.copyMakeBorder(np.hstack(frames), 2, 2, 2, 2, cv2.BORDER_CONSTANT, value=(255, 255, 255)))
    tiles += [np.full_like(tiles[0], 255)] * (-len(tiles) % settings.columns)
    lines = [np.hstack(tiles[i : i + settings.columns]) for i in range(0, len(tiles), settings.columns)]
    cv2.imwrite(str(settings.out), cv2.cvtColor(np.vstack(lines), cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, 85])


if __name__ == "__main__":
    main(tyro.cli(Settings))
