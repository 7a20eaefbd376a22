"""A pair made ready for alignment once: matches between the frames, and both as `rigid.refine` wants them."""

from __future__ import annotations

from functools import cached_property

from objectflow.alignment import registration
from objectflow.alignment.matching import PixelMatches, find_matches
from objectflow.frame import RgbdFrame

MATCH_WIDTH = 640
"""Pixels: wider frames are narrowed to it first. More adds time, no exactness that the depth would bear."""


class FramePair:
    """What every step that aligns something asks of a pair; each thing is made when it is first asked for.

    Attributes:
        prev, curr: the frames.
        prev_m, curr_m: the same, narrowed; what follows is theirs.
    """

    def __init__(self, prev: RgbdFrame, curr: RgbdFrame, width: int = MATCH_WIDTH) -> None:
        self.prev, self.curr = prev, curr
        self.prev_small, self.curr_small = prev.downscaled_to_width(width), curr.downscaled_to_width(width)

    @cached_property
    def matches(self) -> PixelMatches:
        """Between the frames."""
        return find_matches(self.prev_small, self.curr_small)

    @cached_property
    def target(self) -> registration.RegistrationTarget:
        """The previous frame."""
        return registration.RegistrationTarget(self.prev_small)

    @cached_property
    def sources(self) -> registration.RegistrationSources:
        """The current frame."""
        return registration.RegistrationSources(self.curr_small)
