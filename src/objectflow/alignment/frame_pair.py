"""A pair made ready for alignment once: matches between the frames, and both as `rigid.refine` wants them."""

from __future__ import annotations

from functools import cached_property

from objectflow.alignment import registration
from objectflow.alignment.matching import Matches, find_matches
from objectflow.frame import RgbdFrame

WIDTH = 640
"""Pixels: wider frames are narrowed to it first. More adds time, no exactness that the depth would bear."""


class Readied:
    """What every step that aligns something asks of a pair; each thing is made when it is first asked for.

    Attributes:
        prev, curr: the frames.
        prev_m, curr_m: the same, narrowed; what follows is theirs.
    """

    def __init__(self, prev: RgbdFrame, curr: RgbdFrame, width: int = WIDTH) -> None:
        self.prev, self.curr = prev, curr
        self.prev_m, self.curr_m = prev.narrowed(width), curr.narrowed(width)

    @cached_property
    def matches(self) -> Matches:
        """Between the frames."""
        return find_matches(self.prev_m, self.curr_m)

    @cached_property
    def target(self) -> registration.Target:
        """The previous frame."""
        return registration.Target(self.prev_m)

    @cached_property
    def sources(self) -> registration.Sources:
        """The current frame."""
        return registration.Sources(self.curr_m)
