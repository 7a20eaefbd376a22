"""One thing that was looked at, and what was seen."""

from __future__ import annotations

from typing import Literal, NamedTuple

Level = Literal["fine", "note", "suspicious"]


class Finding(NamedTuple):
    """What one check says.

    Attributes:
        check: what was looked at, in a word or two.
        level: "fine", "note" (worth knowing), or "suspicious" (results will suffer).
        text: what was seen, with its numbers, and what to do about it.
    """

    check: str
    level: Level
    text: str
