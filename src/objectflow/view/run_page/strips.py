"""Strips of frames: crops around each object, with its mask in the colour of its track."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import cv2
import numpy as np
from scipy import ndimage

from objectflow.frame import RgbdFrame
from objectflow.typing import LabelImage, UInt8Array
from objectflow.view import canvas
from objectflow.view.colors import PAPER, Rgb, object_color
from objectflow.view.report_page.packing import pack_photo
from objectflow.view.run_page.contents import ReportFrame, RunContents, steps

MAX_CROPS = 8
"""Largest number of frames in a strip."""
CROP_SIZE = 160
"""Side of a crop in the page, pixels."""
MARGIN = 1.5
"""Side of a crop, relative to the longest side of the object's largest mask in the strip."""
MIN_SIDE = 64
"""Smallest side of a crop in the frame, pixels."""
MIN_PIXELS = 30
"""Smallest mask that is shown, pixels."""


class Sighting(NamedTuple):
    """A known object in one frame.

    Attributes:
        frame: index in the frames of the run.
        box: left, top, right and bottom of its mask, pixels; right and bottom are the first pixels outside.
    """

    frame: int
    box: tuple[int, int, int, int]


class Crop(NamedTuple):
    """One picture of a strip.

    Attributes:
        frame: of the run.
        moves: whether the object moves in the pair that ends with this frame.
        uri: the picture as a data URI.
    """

    frame: ReportFrame
    moves: bool
    uri: str


def sightings(run: RunContents) -> dict[int, list[Sighting]]:
    """Where the masks of known objects lie in every frame, by track id."""
    found: dict[int, list[Sighting]] = {track.id: [] for track in run.tracks}
    for index, frame in enumerate(run.frames):
        if not frame.pair:
            continue
        known = run.read_known(frame.pair)
        counts = np.bincount(known.ravel())
        for number, box in enumerate(ndimage.find_objects(known), start=1):
            if box is not None and number in found and counts[number] >= MIN_PIXELS:
                rows, columns = box
                found[number].append(Sighting(index, (columns.start, rows.start, columns.stop, rows.stop)))
    return found


def make_strips(run: RunContents, numbers: Sequence[int]) -> dict[int, list[Crop]]:
    """The strip of each of these objects, by track id; every frame is read once."""
    seen = sightings(run)
    moves = {track.id: {step.end for step in steps(track)} for track in run.tracks if track.id in numbers}
    chosen: dict[int, list[Sighting]] = {}
    for number in numbers:
        moving = [one for one in seen[number] if run.frames[one.frame].time in moves[number]]
        chosen[number] = choose(seen[number], moving)
    wanted: dict[int, list[tuple[int, Sighting]]] = {}
    for number, strip in chosen.items():
        for one in strip:
            wanted.setdefault(one.frame, []).append((number, one))
    strips: dict[int, list[Crop]] = {number: [] for number in numbers}
    for index in sorted(wanted):
        entry = run.frames[index]
        frame, known = run.read_frame(entry.number), run.read_known(entry.pair)
        for number, one in wanted[index]:
            side = _side(chosen[number], known.shape)
            picture = draw_crop(frame, known, number, one.box, side)
            strips[number].append(Crop(entry, entry.time in moves[number], pack_photo(picture)))
    return strips


def choose(seen: Sequence[Sighting], moving: Sequence[Sighting]) -> list[Sighting]:
    """At most `MAX_CROPS` sightings in order of time: those with motion first, and both kinds evenly spread."""
    kept = _spread(moving, MAX_CROPS)
    rests = [one for one in seen if one not in moving]
    return sorted([*kept, *_spread(rests, MAX_CROPS - len(kept))])


def draw_crop(
    frame: RgbdFrame, known: LabelImage, number: int, box: tuple[int, int, int, int], side: int
) -> UInt8Array:
    """Crop a frame around a mask, which is tinted and outlined in the colour of its track.

    Args:
        frame: (H, W).
        known: (H, W) track ids.
        number: of the track.
        box: of the mask; the crop is centred on it, but stays inside the frame.
        side: of the crop, pixels of the frame.

    Returns:
        (CROP_SIZE, CROP_SIZE, 3) uint8 RGB.
    """
    height, width = known.shape
    left, top = (
        min(max(round((low + high - side) / 2), 0), length - side)
        for low, high, length in ((box[0], box[2], width), (box[1], box[3], height))
    )
    window = np.s_[top : top + side, left : left + side]
    interpolation = cv2.INTER_AREA if side > CROP_SIZE else cv2.INTER_CUBIC
    photo = cv2.resize(np.ascontiguousarray(frame.color[window]), (CROP_SIZE, CROP_SIZE), interpolation=interpolation)
    mask = (known[window] == number).astype(np.float32)
    inside = cv2.resize(mask, (CROP_SIZE, CROP_SIZE), interpolation=cv2.INTER_LINEAR) > 0.5
    return _marked(np.asarray(photo, dtype=np.uint8), inside, object_color(number))


def _marked(photo: UInt8Array, inside: np.ndarray, color: Rgb) -> UInt8Array:
    kernel = np.ones((3, 3), np.uint8)
    filled = inside.astype(np.uint8)
    edge = (cv2.dilate(filled, kernel) > 0) & (cv2.erode(filled, kernel, borderValue=1) == 0)
    halo = (cv2.dilate(filled, kernel, iterations=2) > 0) & ~edge & ~inside
    image = canvas.blend(photo, color, 0.28 * inside)
    image = canvas.blend(image, PAPER, 0.7 * halo)
    return canvas.blend(image, color, edge.astype(np.float32))


def _side(strip: Iterable[Sighting], shape: tuple[int, ...]) -> int:
    """Side of an object's crops, the same in its whole strip, so that its size can be compared."""
    longest = max(max(right - left, bottom - top) for _, (left, top, right, bottom) in strip)
    return min(max(round(MARGIN * longest), MIN_SIDE), *shape)


def _spread(entries: Sequence[Sighting], count: int) -> list[Sighting]:
    if len(entries) <= count:
        return list(entries)
    return [entries[k] for k in np.linspace(0, len(entries) - 1, count).round().astype(int)] if count else []
