"""Results of methods beside the truth, one row per pair.

    python scripts/gallery.py OUT --data DIR --methods consensus

DIR is a set as in `objectflow evaluate --data`: a generated one, "real:FOLDER" (pair folders with a truth) or "tiny".
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import tyro
from tyro.conf import Positional

from objectflow.evaluation.data.sources import open_set
from objectflow.evaluation.methods import parse_methods
from objectflow.typing import UInt8Array
from objectflow.view import canvas
from objectflow.view.colors import INK
from objectflow.view.overlay import draw_overlay

GAP, HEAD = 6, 26
"""Pixels between pictures, and height of the header with the columns' names."""


@dataclasses.dataclass
class Settings:
    """Draws the previous and the current frame, the truth, and each method's result."""

    out: Positional[Path]
    """Picture to write."""
    methods: tuple[str, ...] = ("consensus",)
    """Methods as in `objectflow evaluate --methods`."""
    data: str = "tiny"
    """Set of pairs with a truth."""
    split: str = "test"
    """Split of a generated set."""
    keys: tuple[str, ...] = ()
    """Keys of the pairs; by default the first ones."""
    pairs: int = 4
    """Number of pairs, if no keys are given."""
    camera: str = "auto"
    """Camera option of all methods."""
    width: int = 320
    """Width of each picture in pixels."""


def main(settings: Settings) -> None:
    """Run the methods, draw their results, and arrange them in a grid."""
    source = open_set(settings.data, split=settings.split)
    specs = parse_methods(["truth=oracle-motion", *settings.methods], camera=settings.camera)
    names = ["previous", "current", *(spec.label for spec in specs)]
    lines = [_header(names, settings.width)]
    for key in settings.keys or source.keys[: settings.pairs]:
        pair = source.pair(key)
        tiles = [pair.prev.color, pair.curr.color]
        tiles += [draw_overlay(pair.curr, spec.make(pair.truth)(pair.prev, pair.curr)) for spec in specs]
        lines.append(_row(tiles, settings.width))
    cv2.imwrite(str(settings.out), cv2.cvtColor(np.vstack(lines), cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, 88])


def _row(tiles: list[UInt8Array], width: int) -> UInt8Array:
    height = round(width * tiles[0].shape[0] / tiles[0].shape[1])
    small = [cv2.resize(tile, (width, height), interpolation=cv2.INTER_AREA) for tile in tiles]
    framed = [cv2.copyMakeBorder(t, 0, GAP, 0, GAP, cv2.BORDER_CONSTANT, value=(255, 255, 255)) for t in small]
    return np.asarray(np.hstack(framed), dtype=np.uint8)


def _header(names: list[str], width: int) -> UInt8Array:
    head = np.full((HEAD, len(names) * (width + GAP), 3), 255, np.uint8)
    for column, name in enumerate(names):
        canvas.write(head, name, column * (width + GAP) + 4, HEAD - 8, 16, INK, bold=True)
    return head


if __name__ == "__main__":
    main(tyro.cli(Settings))
