"""`dense-flow`: optical flow lifted to 3D by the two depth images."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from objectflow.alignment import matching
from objectflow.alignment.frame_pair import FramePair
from objectflow.methods.base import PairEstimator
from objectflow.motion import SceneMotion
from objectflow.settings import Settings


@dataclass(frozen=True)
class DenseFlow(Settings, PairEstimator):
    """DIS optical flow from the current to the previous frame, as the difference of the two back-projected points.

    Pixels where forward and backward flow disagree, or whose match has no depth, take the flow of the nearest valid
    pixel: most of them are occluded in the previous frame and move like their surroundings. The flow of a moving
    camera's background is part of the optical flow.
    """

    def estimate(self, pair: FramePair) -> SceneMotion:
        """See `PairEstimator`."""
        start = time.perf_counter()
        prev, curr = pair.prev.frame, pair.curr.frame
        flow, consistent = matching.dense_flow(pair.prev.gray, pair.curr.gray)
        v, u = np.nonzero(consistent & curr.valid)
        pixels = np.stack([u, v], axis=1).astype(np.float32)
        matches, lifted = matching.lift(pixels, pixels + flow[v, u], prev, curr)
        points = pair.curr.points
        scene_flow = np.zeros_like(points)
        known = np.zeros(curr.depth.shape, bool)
        known[v[lifted], u[lifted]] = True
        scene_flow[known] = matches.prev - points[known]
        if known.any():
            rows, columns = ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True)
            scene_flow = scene_flow[rows, columns]
        scene_flow[~curr.valid] = np.nan
        return SceneMotion(
            labels=np.zeros(curr.depth.shape, np.int32),
            scene_flow=scene_flow,
            method="dense-flow",
            seconds=time.perf_counter() - start,
        )
