"""Draw docs/images/wrong_pairs.jpg: results of `consensus` on the demo pair and on its faulty copies.

python scripts/docs_inputs.py FOLDER           # once
python scripts/docs_pictures.py FOLDER
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np

import objectflow as of
from objectflow.readers import open_pair
from objectflow.typing import UInt8Array
from objectflow.view import draw_overlay

TILES = {
    "good": "as it should be",
    "unregistered": "depth not registered",
    "half_size": "intrinsics of half the size",
    "ray_length": "ray length, not planar z",
    "holes": "45% without depth",
    "lag": "depth later than colour",
    "picture": "8-bit depth",
    "exposure": "exposure changed",
    "swapped": "depths swapped",
}
"""Folder and title of each tile, row by row."""
COLUMNS, WIDTH, STRIP = 3, 400, 30
OUT = Path(__file__).resolve().parents[1] / "docs" / "images" / "wrong_pairs.jpg"


def tile(folder: Path, title: str) -> UInt8Array:
    """The overlay of one pair with a title above it, BGR."""
    prev, curr = open_pair(folder)
    motion = of.load("consensus")(prev, curr)
    picture = draw_overlay(curr, motion)[..., ::-1]
    height = round(WIDTH * picture.shape[0] / picture.shape[1])
    out = np.full((STRIP + height, WIDTH, 3), 255, np.uint8)
    out[STRIP:] = cv2.resize(picture, (WIDTH, height), interpolation=cv2.INTER_AREA)
    cv2.putText(out, title, (6, 21), cv2.FONT_HERSHEY_SIMPLEX, 0.58, (40, 40, 40), 1, cv2.LINE_AA)
    print(f"{folder.name}: {len(motion.objects)} objects")
    return out


def main() -> None:
    """Estimate, draw, tile."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    folder: Path = parser.parse_args().folder
    tiles = [tile(folder / name, title) for name, title in TILES.items()]
    rows = [np.concatenate(tiles[i : i + COLUMNS], axis=1) for i in range(0, len(tiles), COLUMNS)]
    cv2.imwrite(str(OUT), np.concatenate(rows), [cv2.IMWRITE_JPEG_QUALITY, 82])


if __name__ == "__main__":
    main()
