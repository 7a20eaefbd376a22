"""Whether an object came to where it is now, although its motion between two frames is not known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from objectflow.alignment.frame_pair import FramePair
from objectflow.alignment.likelihood import LikelihoodSettings, motion_cost
from objectflow.geometry.depth_noise import DepthNoise
from objectflow.geometry.resample import resize_nearest
from objectflow.settings import Settings, setting
from objectflow.typing import BoolMask, Float64Array, LabelImage


@dataclass(frozen=True)
class ArrivalSettings(Settings):
    """When an object of low score becomes known."""

    likelihood: LikelihoodSettings = LikelihoodSettings()
    """Costs of standing still, by depth alone."""
    changed_cost: float = setting(1.0, minimum=0)
    """Cost of standing still from which a pixel shows a surface that was not there before."""
    min_share: float = setting(0.3, minimum=0, maximum=1)
    """Minimum share of such pixels in the mask of the object."""
    min_pixels: int = setting(60, minimum=1)
    """Minimum number of them, at the width of the likelihood."""


class Arrivals:
    """The surfaces of a pair's current frame that were not there in the previous one; computed when first needed."""

    def __init__(
        self, pair: FramePair, prev_T_curr: Float64Array, noise: DepthNoise, settings: ArrivalSettings
    ) -> None:
        """Take a pair.

        Args:
            pair: the frames.
            prev_T_curr: (4, 4) motion of the static background.
            noise: of the depth.
            settings: see there.
        """
        self._pair, self._prev_T_curr, self._noise, self._settings = pair, prev_T_curr, noise, settings
        self._new: BoolMask | None = None

    @property
    def new(self) -> BoolMask:
        """(H, W) bool at the width of the likelihood: the depth of the previous frame contradicts standing still.

        What was hidden in the previous frame, or out of its view, may have stood still.
        """
        if self._new is None:
            pair, settings = self._pair.at_width(self._settings.likelihood.width), self._settings
            cost, hidden = motion_cost(
                pair.prev.frame,
                pair.curr.points,
                self._prev_T_curr,
                None,
                out_of_view=0.0,
                noise=self._noise,
                settings=settings.likelihood,
            )
            self._new = np.asarray((cost > settings.changed_cost) & ~hidden)
        return self._new

    def contains(self, labels: LabelImage, number: int) -> bool:
        """Whether enough of an object's mask is new.

        Args:
            labels: (H, W) int32 of any size.
            number: of the object.
        """
        new = self.new
        mask = resize_nearest(labels, new.shape) == number
        count = int((mask & new).sum())
        return count >= max(self._settings.min_pixels, self._settings.min_share * int(mask.sum()))
