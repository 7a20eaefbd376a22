"""The numbers in the file names of images, by which colour and depth are paired and put in order.

A name may hold several numbers: a camera, an image size, a frame number, a stamp in two parts. Sizes (`640x480`) and
numbers that are the same in all names are ignored. The remaining ones, together or one of them, form the number of the
frame: the choice that is unique within colour and within depth and that pairs the most images.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from decimal import Decimal
from pathlib import Path
from typing import TypeAlias

from objectflow.errors import ReaderError

Number: TypeAlias = tuple[Decimal, ...]
"""The number of a frame: one number of a file name, or several in their order."""
MIN_STAMP = Decimal(100_000_000)
"""Smallest whole number that is a time stamp and no frame number."""
_SIZE = re.compile(r"(?<![0-9])[0-9]{2,5}x[0-9]{2,5}(?![0-9])", re.IGNORECASE)
_NUMBER = re.compile(r"[0-9]+(?:\.[0-9]+)?")


def number_images(color: Sequence[Path], depth: Sequence[Path]) -> tuple[dict[Number, Path], dict[Number, Path]]:
    """Number colour and depth images so that the images of a frame have the same number.

    Raises:
        ReaderError: two colour images, or two depth images, have the same number.
    """
    groups = [[(path, found) for path in paths if (found := _numbers(path))] for paths in (color, depth)]
    best: tuple[dict[Number, Path], dict[Number, Path]] | None = None
    error: ReaderError | None = None
    length = max((len(numbers) for group in groups for _, numbers in group), default=0)
    # None stands for all numbers together; the last number comes first.
    for choice in (*range(-1, -length - 1, -1), None):
        try:
            numbered = _by_number(groups[0], choice), _by_number(groups[1], choice)
        except ReaderError as reason:
            error = error or reason
            continue
        if best is None or _shared(numbered) > _shared(best):
            best = numbered
    if best is None:
        if error is not None:
            raise error
        return {}, {}
    return best


def seconds(number: Number) -> Decimal | None:
    """The stamp of a number, in the unit of the file name, or None if it is a frame number.

    A stamp has decimals, or at least nine digits; seconds and nanoseconds may be two numbers.
    """
    if len(number) == 2 and number[0] >= MIN_STAMP and number[1] < 1_000_000_000:
        return number[0] + number[1] / 1_000_000_000
    if len(number) != 1:
        return None
    value = number[0]
    return value if value >= MIN_STAMP or value != value.to_integral_value() else None


def _numbers(path: Path) -> list[Decimal]:
    return [Decimal(text) for text in _NUMBER.findall(_SIZE.sub(" ", path.stem))]


def _by_number(group: Sequence[tuple[Path, list[Decimal]]], choice: int | None) -> dict[Number, Path]:
    """The images of a group by one of their numbers, or by all that are not the same in all names."""
    constant: set[int] = set()
    if choice is None and len({len(numbers) for _, numbers in group}) == 1:
        columns = zip(*(numbers for _, numbers in group), strict=True)
        constant = {index for index, column in enumerate(columns) if len(Counter(column)) == 1 and len(group) > 1}
    found: dict[Number, Path] = {}
    for path, numbers in group:
        if choice is None:
            number = tuple(value for index, value in enumerate(numbers) if index not in constant)
        else:
            number = (numbers[max(choice, -len(numbers))],)
        if number in found:
            raise ReaderError(f"{path}: {found[number].name} has the same number")
        found[number] = path
    return found


def _shared(found: tuple[dict[Number, Path], dict[Number, Path]]) -> int:
    return len(found[0].keys() & found[1].keys())
