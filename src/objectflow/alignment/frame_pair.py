"""A pair of frames prepared once: matches between them and both as registration takes them, at any width."""

from __future__ import annotations

import dataclasses
from concurrent.futures import Future
from functools import cached_property
from typing import Any

import numpy as np

from objectflow import geometry
from objectflow.alignment.matching import DEFAULTS as MATCHING
from objectflow.alignment.matching import FlowMatches, MatchSettings, PixelMatches, match_by_flow, match_frames
from objectflow.alignment.prepared_frame import PreparedFrame
from objectflow.alignment.registration import RegistrationSources, RegistrationTarget
from objectflow.frame import RgbdFrame, check_pair
from objectflow.geometry.depth_noise import STRUCTURED_LIGHT, DepthNoise
from objectflow.typing import Float64Array

MATCH_WIDTH = 640
"""Pixels: width at which frames are matched and registered. A larger one costs time, and depth is no more exact."""


class FramePair:
    """Two frames and everything that the steps of a method compute from them.

    Attributes:
        prev, curr: the frames, prepared.
        noise: the noise of their depth, to which thresholds in metres relate.
        matching: which matches between them are accepted.
        memo: what steps compute once and share, by their own keys.
        beside: what side threads compute from the frames alone, by the keys of the steps that started it; pairs of the
            same frames share it.

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
        self.beside: dict[object, Future[Any]] = {}
        self._carried: tuple[FramePair, Float64Array] | None = None
        self._with_features: FramePair | None = None

    def at_width(self, width: int) -> FramePair:
        """The pair downscaled to a width in pixels; itself where it is no wider."""
        if self.curr.frame.camera.width <= width:
            return self
        if width not in self._at:
            smaller = FramePair(
                self.prev.at_width(width), self.curr.at_width(width), noise=self.noise, matching=self.matching
            )
            if self._carried is not None:
                source, seen_T_prev = self._carried
                smaller._carried = source.at_width(width), seen_T_prev
            self._at[width] = smaller
        return self._at[width]

    def with_noise(self, noise: DepthNoise) -> FramePair:
        """The same prepared frames and matches under another noise model."""
        if noise == self.noise:
            return self
        pair = FramePair(self.prev, self.curr, noise=noise, matching=self.matching)
        pair._at = {width: smaller.with_noise(noise) for width, smaller in self._at.items()}
        pair._carried, pair.beside = self._carried, self.beside
        self._share(pair, "flow", "matches")  # they do not depend on the noise
        return pair

    def with_matching(self, matching: MatchSettings) -> FramePair:
        """The same prepared frames, matched under other settings."""
        if matching == self.matching:
            return self
        pair = FramePair(self.prev, self.curr, noise=self.noise, matching=matching)
        pair.beside = self.beside
        return pair

    @property
    def lacks_features(self) -> bool:
        """Whether features are left out of the matches, as optical flow suffices."""
        return self._carried is None and self.flow.share > self.matching.sufficient_flow_share

    def with_features(self) -> FramePair:
        """The same prepared frames with features among their matches in any case; itself where they are already."""
        if self._carried is not None or self.matching.sufficient_flow_share >= 1:
            return self
        if self._with_features is None:
            pair = self.with_matching(dataclasses.replace(self.matching, sufficient_flow_share=1.0))
            pair._at = {width: smaller.with_features() for width, smaller in self._at.items()}
            self._share(pair, "flow")
            if "matches" in vars(self) and not self.lacks_features:
                self._share(pair, "matches")
            self._with_features = pair
        return self._with_features

    def with_previous(self, prev: RgbdFrame, seen_T_prev: Float64Array) -> FramePair:
        """The pair with its previous frame as another camera pose saw it; matches are carried along.

        Args:
            prev: the frame rendered from that pose.
            seen_T_prev: (4, 4) from the previous camera to that pose.
        """
        pair = FramePair(prev, self.curr, noise=self.noise, matching=self.matching)
        pair._carried = self, np.asarray(seen_T_prev, dtype=np.float64)
        return pair

    def followed_by(self, frame: RgbdFrame) -> FramePair:
        """The next pair of a sequence: this pair's current frame, prepared already, becomes the previous one."""
        return FramePair(self.curr, frame, noise=self.noise, matching=self.matching)

    @cached_property
    def flow(self) -> FlowMatches:
        """Matches between the frames by optical flow."""
        return match_by_flow(self.prev, self.curr, self.matching)

    @cached_property
    def matches(self) -> PixelMatches:
        """Matches between the frames; see `match_frames`."""
        if self._carried is not None:
            source, seen_T_prev = self._carried
            found = source.matches
            return PixelMatches(
                found.pixels, found.curr, geometry.transform(seen_T_prev, found.prev).astype(np.float32)
            )
        return match_frames(self.prev, self.curr, self.matching, self.flow)

    @cached_property
    def target(self) -> RegistrationTarget:
        """The previous frame as the target of registration."""
        return RegistrationTarget(self.prev, self.noise)

    @cached_property
    def sources(self) -> RegistrationSources:
        """The current frame, from which the points of an object are taken."""
        return RegistrationSources(self.curr)

    def _share(self, pair: FramePair, *names: str) -> None:
        """Give a pair those of the cached properties that are known here."""
        vars(pair).update({name: vars(self)[name] for name in names if name in vars(self)})
