"""`zero`: zero flow and no objects."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from objectflow import geometry
from objectflow.alignment.frame_pair import FramePair
from objectflow.methods.base import PairEstimator
from objectflow.motion import SceneMotion
from objectflow.settings import Settings


@dataclass(frozen=True)
class Zero(Settings, PairEstimator):
    """Zero flow and no objects, the reference for every error metric."""

    def estimate(self, pair: FramePair) -> SceneMotion:
        """See `PairEstimator`."""
        start = time.perf_counter()
        points = pair.curr.points
        labels = np.zeros(points.shape[:2], np.int32)
        flow = geometry.flow_from_motions(points, labels, {})
        return SceneMotion(labels=labels, scene_flow=flow, method="zero", seconds=time.perf_counter() - start)
