"""`zero`: nothing moves."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from objectflow import geometry
from objectflow.frame import RgbdFrame, check_pair
from objectflow.methods.base import check_camera_option
from objectflow.motion import SceneMotion


@dataclass(frozen=True)
class Zero:
    """Zero flow and no objects; every error measure has this row beside it.

    Attributes:
        camera: accepted like every method's; zero flow is what it is.
    """

    camera: str = "auto"

    def __post_init__(self) -> None:
        check_camera_option(self.camera)

    def __call__(self, prev: RgbdFrame, curr: RgbdFrame) -> SceneMotion:
        """See `Estimator`."""
        start = time.perf_counter()
        check_pair(prev, curr)
        labels = np.zeros(curr.depth.shape, np.int32)
        flow = geometry.flow_from_motions(geometry.back_project(curr.depth, curr.camera), labels, {})
        return SceneMotion(labels=labels, scene_flow=flow, method="zero", seconds=time.perf_counter() - start)
