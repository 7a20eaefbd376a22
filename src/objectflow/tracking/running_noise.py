"""The depth noise of a sequence's camera: the median of what its recent pairs measured."""

from __future__ import annotations

from collections import deque

import numpy as np

from objectflow.alignment.frame_pair import FramePair
from objectflow.alignment.measured_noise import DEFAULTS, MeasuredNoiseSettings, measure_depth_noise
from objectflow.geometry.depth_noise import STRUCTURED_LIGHT, DepthNoise, MeasuredDepthNoise
from objectflow.motion import SceneMotion


class RunningNoise:
    """A running estimate of depth noise. It can be pickled, and its size does not grow with time.

    A single pair measures few bins of depth, and moving objects or a change of light disturb it; the median over
    recent pairs is robust against both.

    Attributes:
        settings: of the measurement in each pair.
        floor: lower bound of the estimate.
    """

    def __init__(
        self, pairs: int, settings: MeasuredNoiseSettings = DEFAULTS, floor: DepthNoise = STRUCTURED_LIGHT
    ) -> None:
        """Start without a measurement.

        Args:
            pairs: number of recent measurements of each bin of depth of which the median is taken.
            settings: of the measurement in each pair.
            floor: lower bound of the estimate.
        """
        self.settings, self.floor = settings, floor
        self._pairs = pairs
        self._bins: dict[int, deque[tuple[float, float]]] = {}
        """Depth and standard deviation, both in metres, by the number of the bin."""

    def add(self, pair: FramePair, motion: SceneMotion) -> DepthNoise:
        """Measure the next pair.

        Args:
            pair: the frames.
            motion: its estimate, which holds the motion of the camera; a pair whose camera is unknown is left out.

        Returns:
            The estimate after this pair.
        """
        if motion.camera_known:
            found = measure_depth_noise(pair, motion.camera_motion, floor=self.floor, settings=self.settings)
            if isinstance(found, MeasuredDepthNoise):
                for depth, sigma in zip(found.depths, found.sigmas, strict=True):
                    number = int(np.floor(np.log(depth) / self.settings.bin_width))
                    self._bins.setdefault(number, deque(maxlen=self._pairs)).append((depth, sigma))
        return self.noise

    @property
    def noise(self) -> DepthNoise:
        """The estimate; `floor` before the first measurement."""
        if not self._bins:
            return self.floor
        depths, sigmas = zip(
            *(np.median(self._bins[number], axis=0).tolist() for number in sorted(self._bins)), strict=True
        )
        return MeasuredDepthNoise(self.floor.base, self.floor.growth, self.floor.near, depths, sigmas)
