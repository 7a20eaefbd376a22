"""Numbers and captions of the objects in `overlay.png`, placed where they cover little of the masks."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np

from objectflow.motion import ObjectMotion
from objectflow.motion.words import motion_caption
from objectflow.typing import BoolMask, UInt8Array
from objectflow.view import canvas
from objectflow.view.colors import INK, PAPER, Rgb, object_color

LEADER = 20
"""Distance from a tag to its mask, in 1/960 of the picture's longer side, above which a line connects the two."""


class _Box(NamedTuple):
    left: float
    top: float
    width: float
    height: float

    def overlap(self, other: _Box) -> float:
        """Common area, square pixels."""
        width = min(self.left + self.width, other.left + other.width) - max(self.left, other.left)
        height = min(self.top + self.height, other.top + other.height) - max(self.top, other.top)
        return max(0.0, width) * max(0.0, height)

    def gap(self, other: _Box) -> float:
        """Distance between the two boxes, pixels; 0 if they overlap."""
        x = max(self.left - other.left - other.width, other.left - self.left - self.width, 0.0)
        y = max(self.top - other.top - other.height, other.top - self.top - self.height, 0.0)
        return math.hypot(x, y)

    def distance(self, point: canvas.Point) -> float:
        """From the nearest point of the box, pixels; 0 inside."""
        x = max(self.left - point[0], 0.0, point[0] - self.left - self.width)
        y = max(self.top - point[1], 0.0, point[1] - self.top - self.height)
        return math.hypot(x, y)


class Tag(NamedTuple):
    """The tag of one object: its number, its caption, the point it belongs to and the box of its mask, in pixels."""

    number: int
    caption: str
    color: Rgb
    anchor: canvas.Point
    box: tuple[float, float, float, float]

    @classmethod
    def of(cls, obj: ObjectMotion, number: int, anchor: canvas.Point, box: tuple[slice, ...], scale: int) -> Tag:
        """The tag of an object whose mask lies in the rows and columns of `box`."""
        rows, columns = box
        sides = (columns.start * scale, rows.start * scale, columns.stop * scale, rows.stop * scale)
        return cls(number, motion_caption(obj), object_color(number), anchor, sides)


def draw_tags(image: UInt8Array, tags: Sequence[Tag], masks: BoolMask, scale: int, unit: float) -> None:
    """Draw number and caption of each object beside it, connected by a line where there is no room nearby."""
    covered = cv2.integral(masks.astype(np.uint8))
    placed: list[tuple[Tag, _Box]] = []
    for tag in tags:
        width, height = _size(tag, unit)
        choices = _candidates(tag, width, height, unit, image.shape)
        costs = [_cost(choice, tag, placed, covered, scale) for choice in choices]
        placed.append((tag, choices[int(np.argmin(costs))]))
    for tag, box in placed:
        left, top, right, bottom = tag.box
        if _Box(left, top, right - left, bottom - top).gap(box) > LEADER * unit:
            end = (
                min(max(tag.anchor[0], box.left), box.left + box.width),
                min(max(tag.anchor[1], box.top), box.top + box.height),
            )
            canvas.line(image, [tag.anchor, end], PAPER, round(3 * unit))
            canvas.line(image, [tag.anchor, end], tag.color, round(1.5 * unit))
    for tag, box in placed:
        _draw(image, tag, box, unit)


def draw_numbers(image: UInt8Array, tags: Sequence[Tag], unit: float) -> None:
    """Draw the number alone on each object."""
    for tag in tags:
        bare = tag._replace(caption="")
        width, height = _size(bare, 0.75 * unit)
        left = min(max(tag.anchor[0] - width / 2, 2), image.shape[1] - width - 2)
        top = min(max(tag.anchor[1] - height / 2, 2), image.shape[0] - height - 2)
        _draw(image, bare, _Box(left, top, width, height), 0.75 * unit)


def draw_legend(image: UInt8Array, tags: Sequence[Tag], unit: float) -> UInt8Array:
    """Append a legend with the captions of all objects that have one below the picture."""
    listed = sorted((tag for tag in tags if tag.caption), key=lambda tag: tag.number)
    sizes = [_size(tag, unit) for tag in listed]
    step = (max(width for width, _ in sizes) + 14 * unit, sizes[0][1] + 9 * unit)
    columns = max(1, int((image.shape[1] - 14 * unit) // step[0]))
    rows = math.ceil(len(listed) / columns)
    height = round(rows * step[1] + 14 * unit)
    sheet = np.full((image.shape[0] + height, *image.shape[1:]), 255, np.uint8)
    sheet[: image.shape[0]] = image
    for index, (tag, (width, tall)) in enumerate(zip(listed, sizes, strict=True)):
        row, column = index % rows, index // rows
        left, top = 14 * unit + column * step[0], image.shape[0] + 10 * unit + row * step[1]
        _draw(sheet, tag, _Box(left, top, width, tall), unit)
    return sheet


def _candidates(tag: Tag, width: float, height: float, unit: float, shape: tuple[int, ...]) -> list[_Box]:
    """Boxes above, below and beside the anchor and the mask, inside the picture."""
    gap = 10 * unit
    left, top, right, bottom = tag.box
    x, y = tag.anchor
    corners = [
        (x + gap, y - gap - height),
        (x - gap - width, y - gap - height),
        (x + gap, y + gap),
        (x - gap - width, y + gap),
    ]
    for out in (gap, 3 * gap, 6 * gap):
        middle = (left + right - width) / 2, (top + bottom - height) / 2
        corners += [(middle[0], top - out - height), (middle[0], bottom + out)]
        corners += [(right + out, middle[1]), (left - out - width, middle[1])]
        corners += [(right + out, top - out - height), (left - out - width, top - out - height)]
        corners += [(right + out, bottom + out), (left - out - width, bottom + out)]
    most = (shape[1] - width - 4 * unit, shape[0] - height - 4 * unit)
    return [_Box(min(max(a, 4 * unit), most[0]), min(max(b, 4 * unit), most[1]), width, height) for a, b in corners]


def _cost(box: _Box, tag: Tag, placed: Sequence[tuple[Tag, _Box]], covered: np.ndarray, scale: int) -> float:
    """Covered area of masks and of tags relative to the box, plus the distance to the anchor in box widths."""
    height, width = (length - 1 for length in covered.shape)
    x0, x1 = (min(max(int(x / scale), 0), width) for x in (box.left, box.left + box.width + scale))
    y0, y1 = (min(max(int(y / scale), 0), height) for y in (box.top, box.top + box.height + scale))
    masks = float(covered[y1, x1] - covered[y0, x1] - covered[y1, x0] + covered[y0, x0]) * scale**2
    others = sum(box.overlap(other) for _, other in placed)
    anchors = sum(box.distance(other.anchor) == 0 for other, _ in placed)
    area = box.width * box.height
    return (masks + 4 * others) / area + 2.0 * anchors + 0.35 * box.distance(tag.anchor) / box.width


def _size(tag: Tag, unit: float) -> tuple[float, float]:
    """Width and height of a tag, pixels."""
    size, pad = 17 * unit, 7 * unit
    number_width, height = canvas.text_size(str(tag.number), size, bold=True)
    width = max(number_width, height) + 2 * pad
    if tag.caption:
        width += canvas.text_size(tag.caption, size)[0] + 16 * unit
    return width, height + 1.7 * pad


def _draw(image: UInt8Array, tag: Tag, box: _Box, unit: float) -> None:
    """Draw a rounded tag: the number on its colour, and the caption."""
    size, pad = 17 * unit, 7 * unit
    number_width, height = canvas.text_size(str(tag.number), size, bold=True)
    badge = max(number_width, height) + 2 * pad
    rim = 1.5 * unit
    _rounded(image, _Box(box.left - rim, box.top - rim, box.width + 2 * rim, box.height + 2 * rim), PAPER, 6.5 * unit)
    _rounded(image, _Box(box.left, box.top, badge, box.height), tag.color, 5 * unit)
    baseline = box.top + (box.height + height) / 2
    canvas.write(image, str(tag.number), box.left + (badge - number_width) / 2, baseline, size, PAPER, bold=True)
    if tag.caption:
        canvas.write(image, tag.caption, box.left + badge + 7 * unit, baseline, size, INK)


def _rounded(image: UInt8Array, box: _Box, color: Rgb, radius: float) -> None:
    right, bottom = box.left + box.width, box.top + box.height
    x0, x1, y0, y1 = box.left + radius, right - radius, box.top + radius, bottom - radius
    canvas.polygon(image, [(x0, box.top), (x1, box.top), (x1, bottom), (x0, bottom)], color)
    canvas.polygon(image, [(box.left, y0), (right, y0), (right, y1), (box.left, y1)], color)
    for x in (x0, x1):
        for y in (y0, y1):
            canvas.disk(image, (x, y), radius, color)
