"""Draw a data set's first pairs on one sheet: `python scripts/contact_sheet.py data sheet.jpg`."""

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
from objectflow.dataset.show import label_color
from objectflow.typing import LabelImage, UInt8Array


@dataclasses.dataclass
class Settings:
    """Draws previous and current frames side by side, in rows."""

    data: Positional[Path]
    """Folder of the data set."""
    out: Positional[Path]
    """Picture to write."""
    split: str = "train"
    """Part of the set."""
    pairs: int = 40
    """How many."""
    columns: int = 5
    """Pairs a row."""
    width: int = 160
    """Pixels of each frame."""
    movers: bool = False
    """Outline what moves: in the previous frame where it was, in the current one where it is."""


def outline(picture: UInt8Array, labels: LabelImage, row: PairRow) -> UInt8Array:
    """The picture with a line around every object that moves; a white square in the corner where the camera does."""
    picture = np.ascontiguousarray(picture)
    size = (picture.shape[1], picture.shape[0])
    for label in sorted(moving_labels(row)):
        mask = cv2.resize((labels == label).astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)
        lines, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        cv2.drawContours(picture, lines, -1, label_color(label), 1)
    if row.camera_motion is not None and not np.array_equal(row.camera_motion, np.eye(4)):
        cv2.rectangle(picture, (2, 2), (8, 8), (255, 255, 255), -1)
        cv2.rectangle(picture, (2, 2), (8, 8), (0, 0, 0), 1)
    return np.asarray(picture, dtype=np.uint8)


def main(settings: Settings) -> None:
    """Read, shrink, and lay side by side."""
    rows = open_pairs(settings.data, settings.split)
    tiles = []
    for index in range(min(settings.pairs, len(rows))):
        row = rows[index]
        size = (settings.width, settings.width * row.curr.camera.height // row.curr.camera.width)
        frames = [cv2.resize(f.color, size, interpolation=cv2.INTER_AREA) for f in (row.prev, row.curr)]
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
