"""`dense-flow`: optical flow, lifted to 3D by the two depth images."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from objectflow import geometry
from objectflow.alignment import matching
from objectflow.frame import RgbdFrame, check_pair
from objectflow.methods.base import check_camera_option
from objectflow.motion import SceneMotion


@dataclass(frozen=True)
class DenseFlow:
    """DIS optical flow from the current to the previous frame; a pixel's flow is the difference of its two points.

    Where forward and backward flow disagree, or the other end has no depth, the flow of the nearest pixel that
    has one is taken: such pixels are mostly hidden in the previous frame and move like what is beside them.

    Attributes:
        camera: accepted like every method's; the flow of a moving camera's background is simply part of the flow.
    """

    camera: str = "auto"

    def __post_init__(self) -> None:
        check_camera_option(self.camera)

    def __call__(self, prev: RgbdFrame, curr: RgbdFrame) -> SceneMotion:
        """See `Estimator`."""
        start = time.perf_counter()
        check_pair(prev, curr)
        flow, consistent = matching.dense_flow(matching.gray(prev.color), matching.gray(curr.color))
        v, u = np.nonzero(consistent & curr.valid)
        pixels = np.stack([u, v], axis=1).astype(np.float32)
        matches, lifted = matching.lift(pixels, pixels + flow[v, u], prev, curr)
        points = geometry.back_project(curr.depth, curr.camera)
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
