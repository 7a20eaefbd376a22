"""`oracle-motion`: true motions with our grouping, which shows how much of a network's error is the grouping's."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
import torch

from objectflow import geometry
from objectflow.alignment.frame_pair import FramePair
from objectflow.dataset.targets import RADIUS_ALONE
from objectflow.errors import ResultError
from objectflow.evaluation.data.truth import PairTruth
from objectflow.methods.base import PairEstimator
from objectflow.methods.sceneflownet.averaging import average_motions
from objectflow.methods.sceneflownet.grouping import GroupingSettings, group, trajectory_feature
from objectflow.motion import SceneMotion
from objectflow.typing import Float32Array, Float64Array


@dataclass(frozen=True, eq=False)
class OracleMotion(PairEstimator):
    """An estimator whose dense maps (mask, X, T, R, eta, B) are the truth and whose labels are those of the grouping.

    Its errors are those of the grouping: objects with the same trajectory feature, and objects with fewer pixels than
    `settings.min_pixels`.

    Attributes:
        truth: of the pair.
        background_prev_T_curr: (4, 4) true camera motion, None for a static camera.
        settings: of the grouping; the defaults when None.
    """

    truth: PairTruth
    background_prev_T_curr: Float64Array | None = None
    settings: GroupingSettings | None = None

    def estimate(self, pair: FramePair) -> SceneMotion:
        """See `PairEstimator`.

        Raises:
            FrameError: frames that differ in size or intrinsics.
            ResultError: a truth of another size than the frame.
        """
        start = time.perf_counter()
        curr, points = pair.curr.frame, pair.curr.points
        true = self.truth.labels
        if true.shape != curr.depth.shape:
            raise ResultError(f"{self.truth.key}: the truth is {true.shape}, the frame {curr.depth.shape}")
        # 1. The dense maps of a perfect network.
        center, translation, rotation, radius = self._maps()
        distance = np.linalg.norm(points - center, axis=-1)
        # 2. Our grouping; pixels nearer to their object's centre come first, as with eta.
        settings = self.settings or GroupingSettings()
        X, T, R = (_to_torch(one) for one in (center, translation, rotation))
        feature = trajectory_feature(X, T, R, settings.rotation_weight)
        eta = torch.from_numpy(-np.nan_to_num(distance, nan=1e3))
        labels = group(feature, torch.from_numpy(true > 0), eta, torch.from_numpy(radius), settings).numpy()
        # 3. Our averaging, and the flow of the averaged motions.
        objects = average_motions(
            labels, rotation, translation, center, confidence=np.ones(labels.shape, dtype=np.float32)
        )
        motions = {obj.id: obj.prev_T_curr for obj in objects}
        return SceneMotion(
            labels=labels,
            scene_flow=geometry.flow_from_motions(points, labels, motions, self.background_prev_T_curr),
            objects=objects,
            camera_motion=self.background_prev_T_curr,
            method="oracle-motion",
            seconds=time.perf_counter() - start,
        )

    def _maps(self) -> tuple[Float32Array, Float32Array, Float32Array, Float32Array]:
        """X, T and R, (H, W, 3), and B, (H, W): half the distance to the nearest other trajectory (equation 6)."""
        objects = self.truth.objects
        table = np.zeros((int(self.truth.labels.max(initial=0)) + 1, 10), np.float32)
        center = np.array([obj.center for obj in objects]).reshape(-1, 3)
        moved = np.array([geometry.transform(obj.prev_T_curr, obj.center) for obj in objects]).reshape(-1, 3)
        trajectory = np.concatenate([center, moved], axis=1)
        for k, obj in enumerate(objects):
            others = np.delete(trajectory, k, axis=0)
            gaps = np.linalg.norm(others - trajectory[k], axis=1)
            B = 0.5 * gaps.min() if len(gaps) else RADIUS_ALONE
            rotation = geometry.so3_log(obj.prev_T_curr[:3, :3])
            table[obj.label] = np.concatenate([center[k], moved[k] - center[k], rotation, [B]])
        dense = table[self.truth.labels]
        return dense[..., :3], dense[..., 3:6], dense[..., 6:9], np.ascontiguousarray(dense[..., 9])


def _to_torch(dense: Float32Array) -> torch.Tensor:
    """(H, W, 3) -> (3, H, W)."""
    return torch.from_numpy(np.ascontiguousarray(dense.transpose(2, 0, 1)))
