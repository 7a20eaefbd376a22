"""How probable an object's motion is before its pixels are compared: the nearer to the present one, the more."""

from __future__ import annotations

import numpy as np

from objectflow import geometry
from objectflow.methods.postprocess.pose_hypotheses import PoseHypotheses
from objectflow.methods.postprocess.search_settings import MotionSearchSettings
from objectflow.typing import Float64Array


class MotionPrior:
    """Costs of hypotheses, in nats per pixel of the object.

    Args:
        first: (4, 4) the object's present motion.
        center: (3,) metres: the centre of its points.
        pixels: number of its pixels.
        settings: the costs.
    """

    def __init__(self, first: Float64Array, center: Float64Array, pixels: int, settings: MotionSearchSettings) -> None:
        self._first, self._center, self._settings = first, center, settings
        self._weight = float(np.sqrt(settings.usual_pixels / pixels))

    def __call__(self, hypotheses: PoseHypotheses) -> Float64Array:
        """(K,) the cost of being far from the present motion."""
        settings = self._settings
        distance = np.linalg.norm(hypotheses.positions - geometry.transform(self._first, self._center), axis=1)
        angle = geometry.rotation_angle(hypotheses.rotations @ self._first[:3, :3].T)
        return np.asarray(self._weight * (settings.cost_per_metre * distance + settings.cost_per_radian * angle))

    def hypothesis(self, prev_T_curr: Float64Array) -> PoseHypotheses:
        """A motion (4, 4) as a single hypothesis."""
        return PoseHypotheses(prev_T_curr[None, :3, :3], geometry.transform(prev_T_curr, self._center)[None])
