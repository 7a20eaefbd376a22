"""The `vo-sf` estimator: the steps of the method in order, and their result on the pixels of the input."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.sparse.csgraph import connected_components

from objectflow import geometry
from objectflow.alignment.frame_pair import FramePair
from objectflow.geometry.moved import STATIC_SHIFT_PX, STATIC_SIGMAS, exceeds_noise
from objectflow.methods.base import PairEstimator
from objectflow.methods.baselines.vo_sf.clusters import COUNT, Clusters, cluster
from objectflow.methods.baselines.vo_sf.motions import cluster_motions, robust_odometry
from objectflow.methods.baselines.vo_sf.pyramid import Level, build_pyramid
from objectflow.methods.baselines.vo_sf.segment import MOVING, STATIC, segment
from objectflow.motion import ObjectMotion, SceneMotion
from objectflow.settings import Settings, setting
from objectflow.typing import BoolMask, Float32Array, Float64Array, LabelImage

_ROWS = 128
"""Number of image rows per chunk of soft labels, which bounds the memory for large images."""


@dataclass(frozen=True)
class VoSf(Settings, PairEstimator):
    """Joint visual odometry and scene flow on geometric clusters."""

    camera: Literal["auto", "static", "moving"] = "auto"
    """Use of the camera motion, which is always estimated. static: the flow of static clusters is exactly 0, as in the
    authors' program. moving: it follows from the camera motion. auto: moving if that motion shifts the median
    static pixel by at least `static_shift_px` or `static_sigmas`."""
    static_shift_px: float = setting(STATIC_SHIFT_PX, minimum=0)
    """Pixels: see `camera`."""
    static_sigmas: float = setting(STATIC_SIGMAS, minimum=0)
    """Standard deviations of depth: see `camera`."""

    def estimate(self, pair: FramePair) -> SceneMotion:
        """See `PairEstimator`. Frames of any size are processed at 320x240.

        Raises:
            FrameError: a frame has no depth at 320x240.
        """
        start = time.perf_counter()
        prev, curr = pair.prev.frame, pair.curr.frame
        # 1. Pyramids. The method's first frame, which carries the result, is the current one.
        first, second = build_pyramid(curr), build_pyramid(prev)
        # 2. Geometric clusters.
        clusters = cluster(first)
        labels = clusters.labels(first[0].points)
        # 3. Motion of most of the image, and first segmentation.
        b = segment(first[0], second[0], clusters, labels, robust_odometry(first, second))
        # 4. Camera motion from the static clusters, and motions of the other clusters.
        curr_T_prev, cluster_curr_T_prev = cluster_motions(first, second, clusters, b)
        # 5. Final segmentation.
        b = segment(first[0], second[0], clusters, labels, curr_T_prev)
        # 6. Flow of each pixel, blended from the motions of its clusters.
        static = b < STATIC
        camera_motion = self._camera_motion(curr_T_prev, first[0], np.append(static, False)[labels])
        background = np.eye(4) if camera_motion is None else camera_motion
        motions = np.where(static[:, None, None], background, geometry.inverse(cluster_curr_T_prev))
        points = pair.curr.points
        cluster_labels, flow = _blend_flow(clusters, motions, points)
        object_labels, objects = _merge_clusters(clusters, b, cluster_labels, points, flow)
        return SceneMotion(
            labels=object_labels,
            scene_flow=flow,
            objects=objects,
            camera_motion=camera_motion,
            method="vo-sf",
            seconds=time.perf_counter() - start,
        )

    def _camera_motion(self, curr_T_prev: Float64Array, level: Level, static: BoolMask) -> Float64Array | None:
        prev_T_curr = geometry.inverse(curr_T_prev)
        if self.camera == "static":
            return None
        points = level.points[static].astype(np.float64)
        moved = exceeds_noise(
            prev_T_curr, points, level.camera, shift_px=self.static_shift_px, sigmas=self.static_sigmas
        )
        return prev_T_curr if moved or self.camera == "moving" else None


def _blend_flow(
    clusters: Clusters, prev_T_curr: Float64Array, points: Float32Array
) -> tuple[LabelImage, Float32Array]:
    """(24, 4, 4) motions and (H, W, 3) points, NaN where missing -> cluster labels (H, W) and flow (H, W, 3)."""
    # Displacements are blended instead of positions, so that the flow of static clusters is exactly 0.
    displacement = (prev_T_curr - np.eye(4))[:, :3].reshape(COUNT, 12).astype(np.float32)
    labels, flow = np.empty(points.shape[:2], np.int32), np.empty_like(points)
    for start in range(0, len(points), _ROWS):
        rows = slice(start, start + _ROWS)
        known = np.nan_to_num(points[rows])
        labels[rows], soft = clusters.assign(known)
        blended = (soft @ displacement).reshape(*known.shape[:2], 3, 4)
        flow[rows] = (blended[..., :3] @ known[..., None])[..., 0] + blended[..., 3]
    flow[labels == COUNT] = np.nan
    return labels, flow


def _merge_clusters(
    clusters: Clusters, b: Float64Array, cluster_labels: LabelImage, points: Float32Array, flow: Float32Array
) -> tuple[LabelImage, tuple[ObjectMotion, ...]]:
    """Merge connected moving clusters to objects, with the rigid motion closest to their flow."""
    moving = b > MOVING
    _, group = connected_components(clusters.connected & moving[:, None] & moving, directed=False)
    labels = np.zeros(cluster_labels.shape, np.int32)
    objects: list[ObjectMotion] = []
    for value in dict.fromkeys(group[moving]):
        in_object = np.append(moving & (group == value), False)
        mask = in_object[cluster_labels]
        if not mask.any():
            continue
        labels[mask] = len(objects) + 1
        surface = points[mask].astype(np.float64)
        prev_T_curr, _ = geometry.kabsch(surface, surface + flow[mask])
        objects.append(
            ObjectMotion(
                id=len(objects) + 1,
                pixels=int(mask.sum()),
                score=float(np.clip(b[cluster_labels[mask]].mean() / 2, 0, 1)),
                moving=True,
                center=surface.mean(0),
                prev_T_curr=prev_T_curr,
            )
        )
    return labels, tuple(objects)
