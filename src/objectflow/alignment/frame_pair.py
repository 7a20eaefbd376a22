"""A pair of frames prepared once: matches between them and both as registration takes them, at any width."""

from __future__ import annotations

from functools import cached_property
from typing import Any

from objectflow.alignment.matching import DEFAULTS as MATCHING
from objectflow.alignment.matching import MatchSettings, PixelMatches, match_frames
from objectflow.alignment.prepared_frame import PreparedFrame
from objectflow.alignment.registration import RegistrationSources, RegistrationTarget
from objectflow.frame import RgbdFrame, check_pair
from objectflow.geometry.depth_noise import STRUCTURED_LIGHT, DepthNoise

MATCH_WIDTH = 640
"""Pixels: width at which frames are matched and registered. A larger one costs time, and depth is no more exact."""


class FramePair:
    """Two frames and everything that the steps of a method compute from them.

    Attributes:
        prev, curr: the frames, prepared.
        noise: the noise of their depth, to which thresholds in metres relate.
        matching: which matches between them are accepted.
        memo: what steps compute once and share, by their own keys.

    Raises:
        FrameError: the frames differ in size or intrinsics.
    """

    def __init__(
        self,
        prev: RgbdFrame | PreparedFrame,
        curr: RgbdFrame | PreparedFrame,
        *,
        noise: DepthNoise = STRUCTURED_LIGHT,
        matching: MatchSettings = MATCHING,
    ) -> None:
        self.prev, self.curr = PreparedFrame.of(prev), PreparedFrame.of(curr)
        check_pair(self.prev.frame, self.curr.frame)
        self.noise, self.matching = noise, matching
        self._at: dict[int, FramePair] = {}
        self.memo: dict[object, Any] = {}

    def at_width(self, width: int) -> FramePair:
        """The pair downscaled to a width in pixels; itself where it is no wider."""
        if self.curr.frame.camera.width <= width:
            return self
        if width not in self._at:
            self._at[width] = FramePair(
                self.prev.at_width(width), self.curr.at_width(width), noise=self.noise, matching=self.matching
            )
        return self._at[width]

    def with_noise(self, noise: DepthNoise) -> FramePair:
        """The same prepared frames and matches under another noise model."""
        if noise == self.noise:
            return self
        pair = FramePair(self.prev, self.curr, noise=noise, matching=self.matching)
        pair._at = {width: smaller.with_noise(noise) for width, smaller in self._at.items()}
        if "matches" in vars(self):
            vars(pair)["matches"] = self.matches  # matches do not depend on the noise
        return pair

    def with_matching(self, matching: MatchSettings) -> FramePair:
        """The same prepared frames, matched under other settings."""
        if matching == self.matching:
            return self
        return FramePair(self.prev, self.curr, noise=self.noise, matching=matching)

    def followed_by(self, frame: RgbdFrame) -> FramePair:
        """The next pair of a sequence: this pair's current frame, prepared already, becomes the previous one."""
        return FramePair(self.curr, frame, noise=self.noise, matching=self.matching)

    @cached_property
    def matches(self) -> PixelMatches:
        """Matches between the frames, by optical flow and by features."""
        return match_frames(self.prev, self.curr, self.matching)

    @cached_property
    def target(self) -> RegistrationTarget:
        """The previous frame as the target of registration."""
        return RegistrationTarget(self.prev, self.noise)

    @cached_property
    def sources(self) -> RegistrationSources:
        """The current frame, from which the points of an object are taken."""
        return RegistrationSources(self.curr)
