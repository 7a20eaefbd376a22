"""Draw a data set's first pairs on one sheet: `python scripts/contact_sheet.py data sheet.jpg`."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import tyro
from tyro.conf import Positional

from objectflow.dataset.shards import open_pairs


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


def main(settings: Settings) -> None:
    """Read, shrink, and lay side by side."""
    rows = open_pairs(settings.data, settings.split)
    tiles = []
    for index in range(min(settings.pairs, len(rows))):
        row = rows[index]
        size = (settings.width, settings.width * row.curr.camera.height // row.curr.camera.width)
        frames = [cv2.resize(f.color, size, interpolation=cv2.INTER_AREA) for f in (row.prev, row.curr)]
        tiles.append(cv2.copyMakeBorder(np.hstack(frames), 2, 2, 2, 2, cv2.BORDER_CONSTANT, value=(255, 255, 255)))
    tiles += [np.full_like(tiles[0], 255)] * (-len(tiles) % settings.columns)
    lines = [np.hstack(tiles[i : i + settings.columns]) for i in range(0, len(tiles), settings.columns)]
    cv2.imwrite(str(settings.out), cv2.cvtColor(np.vstack(lines), cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, 85])


if __name__ == "__main__":
    main(tyro.cli(Settings))
