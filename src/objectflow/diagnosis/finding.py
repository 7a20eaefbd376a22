"""The result of one check."""

from __future__ import annotations

from typing import Literal, NamedTuple

Level = Literal["fine", "note", "suspicious"]


class Finding(NamedTuple):
    """The result of one check.

    Attributes:
        check: name of the check, one to three words.
        level: "fine", "note" (worth knowing) or "suspicious" (results will suffer).
        text: the observation with its numbers, and the remedy if there is one.
    """

    check: str
    level: Level
    text: str
