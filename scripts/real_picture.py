"""Draw docs/images/real.jpg, the README's picture of real pairs: right results and wrong ones, of three sensors.

    python scripts/real_picture.py DATA

DATA is a folder of pair folders, or a folder above such folders; pairs that are missing are left out.
"""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

import objectflow as of
from objectflow.alignment.prepared_frame import PreparedFrame
from objectflow.geometry.resample import nearest_indices
from objectflow.readers import open_pair
from objectflow.typing import UInt8Array
from objectflow.view import canvas, draw_overlay
from objectflow.view.colors import INK

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "benchmarks"))
from quarter_turns import turn_back, turn_frame  # noqa: E402

OUT = ROOT / "docs" / "images" / "real.jpg"
WIDTH, HEIGHT, CAPTION, GAP, COLUMNS = 360, 252, 32, 10, 2
"""Pixels of a picture, of the line below it and between pictures, and number of pairs beside each other."""
DRAWN_WIDTH = 480
"""Pixels: width at which overlays are drawn, so that their text remains legible."""
MIN_SCORE = 0.3
"""Objects with a lower score, such as those that no rigid motion explains, are left out."""
WRONG = (200, 30, 30)
"""Colour of the captions of wrong results."""


class Shown(NamedTuple):
    """A pair of the picture: folder, whether the result is right, caption, quarter turns of the frames, camera."""

    name: str
    right: bool
    caption: str
    quarters: int = 0
    camera: str = "auto"


PAIRS = (
    Shown("bin_1", True, "RealSense, moving camera: carrot and ball", camera="moving"),
    Shown("morobot_003_004", True, "RealSense, held by hand: one part, turned by 85 degrees"),
    Shown("maizena2f_c1_010_011", True, "Xtion: one box; nothing else moved"),
    Shown("cup_069_072", True, "RealSense: an arm and the mug that it pushes"),
    Shown("robot", True, "a robot drives by"),
    Shown("cup_021_024", False, "RealSense: the mug is one object with the hand that holds it"),
    Shown("brain_420_435", False, "DepthSense: a toy that turns is found in pieces"),
    Shown("maizena2f_c2_003_004", False, "Xtion, frames turned by a quarter: the box is missed", quarters=1),
)


def main(data: Path) -> None:
    """Estimate, draw, arrange."""
    folders = {path.parent.name: path.parent for path in data.rglob("camera.json")}
    cells = [_cell(folders[shown.name], shown) for shown in PAIRS if shown.name in folders]
    if not cells:
        raise SystemExit(f"{data}: none of the pairs {', '.join(shown.name for shown in PAIRS)}")
    blank = np.full_like(cells[0], 255)
    cells += [blank] * (-len(cells) % COLUMNS)
    rows = [np.hstack(cells[first : first + COLUMNS]) for first in range(0, len(cells), COLUMNS)]
    picture = np.vstack(rows)[:, : -2 * GAP]
    cv2.imwrite(str(OUT), cv2.cvtColor(picture, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, 86])


def _cell(folder: Path, shown: Shown) -> UInt8Array:
    """The previous frame and the result beside each other, with the caption below."""
    prev, curr = open_pair(folder)
    estimator = of.load("rigidmatch", camera=shown.camera)
    motion = turn_back(estimator(turn_frame(prev, shown.quarters), turn_frame(curr, shown.quarters)), shown.quarters)
    small = PreparedFrame(curr).resized(DRAWN_WIDTH, round(DRAWN_WIDTH * curr.camera.height / curr.camera.width)).frame
    rows, columns = nearest_indices(curr.depth.shape, small.depth.shape)
    shown_objects = tuple(obj for obj in motion.objects if obj.score > MIN_SCORE)
    labels = np.where(np.isin(motion.labels, [obj.id for obj in shown_objects]), motion.labels, np.int32(0))
    motion = dataclasses.replace(
        motion,
        labels=labels[rows[:, None], columns],
        scene_flow=motion.scene_flow[rows[:, None], columns],
        objects=shown_objects,
    )
    tiles = [_fitted(image) for image in (prev.color, draw_overlay(small, motion))]
    cell = np.full((HEIGHT + CAPTION + GAP, 2 * WIDTH + 3 * GAP, 3), 255, np.uint8)
    for place, tile in enumerate(tiles):
        cell[:HEIGHT, place * (WIDTH + GAP) : place * (WIDTH + GAP) + WIDTH] = tile
    mark, color = ("right", INK) if shown.right else ("wrong", WRONG)
    canvas.write(cell, f"{mark}: {shown.caption}", 4, HEIGHT + CAPTION - 10, 15, color, bold=not shown.right)
    return cell


def _fitted(image: UInt8Array) -> UInt8Array:
    """An image scaled to fill a picture; what is too long is cut off evenly on both sides."""
    height, width = image.shape[:2]
    factor = max(WIDTH / width, HEIGHT / height)
    size = (max(WIDTH, round(width * factor)), max(HEIGHT, round(height * factor)))
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    top, left = (small.shape[0] - HEIGHT) // 2, (small.shape[1] - WIDTH) // 2
    return np.asarray(small[top : top + HEIGHT, left : left + WIDTH], dtype=np.uint8)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
