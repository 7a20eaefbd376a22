"""The estimator: the steps of the method in order, and their result on the pixels of the input."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
from scipy.sparse.csgraph import connected_components

from objectflow import geometry
from objectflow.frame import RgbdFrame, check_pair
from objectflow.geometry.depth_noise import depth_sigma
from objectflow.methods.base import check_camera_option
from objectflow.methods.baselines.vo_sf.clusters import COUNT, Clusters, cluster
from objectflow.methods.baselines.vo_sf.motions import cluster_motions, robust_odometry
from objectflow.methods.baselines.vo_sf.pyramid import Level, build_pyramid
from objectflow.methods.baselines.vo_sf.segment import MOVING, STATIC, segment
from objectflow.motion import ObjectMotion, SceneMotion
from objectflow.typing import BoolMask, Float32Array, Float64Array, LabelImage

_ROWS = 128
"""Image rows whose soft labels are made at a time: large images need little more memory than small ones."""


@dataclass(frozen=True)
class VoSf:
    """Joint visual odometry and scene flow on geometric clusters.

    Attributes:
        camera: what is told of the camera's motion, which the method finds in any case. "static": the flow of static
            clusters is exactly 0, as in the authors' program; "moving": it is what the camera's motion makes it;
            "auto": "moving" where that motion shifts the median static pixel by 0.7 pixels or 3 sigma of depth.
    """

    camera: str = "auto"

    def __post_init__(self) -> None:
        check_camera_option(self.camera)

    def __call__(self, prev: RgbdFrame, curr: RgbdFrame) -> SceneMotion:
        """See `Estimator`. Frames of any size are worked on at 320x240.

        Raises:
            FrameError: the frames differ, or have no depth left at 320x240.
        """
        start = time.perf_counter()
        check_pair(prev, curr)
        # 1. Pyramids; the current frame is the method's first, whose pixels carry the result.
        first, second = build_pyramid(curr), build_pyramid(prev)
        # 2. Geometric clusters.
        clusters = cluster(first)
        labels = clusters.labels(first[0].points)
        # 3. The motion that most of the image follows, and which clusters do not follow it.
        b = segment(first[0], second[0], clusters, labels, robust_odometry(first, second))
        # 4. The camera's motion from the static clusters, and each other cluster's own.
        curr_T_prev, cluster_curr_T_prev = cluster_motions(first, second, clusters, b)
        # 5. Which clusters move, once more.
        b = segment(first[0], second[0], clusters, labels, curr_T_prev)
        # 6. The flow of each pixel: its clusters' motions, blended.
        static = b < STATIC
        camera_motion = self._camera_motion(curr_T_prev, first[0], np.append(static, False)[labels])
        background = np.eye(4) if camera_motion is None else camera_motion
        motions = np.where(static[:, None, None], background, geometry.inverse(cluster_curr_T_prev))
        points = geometry.back_project(curr.depth, curr.camera)
        member, flow = _paint(clusters, motions, points)
        final, objects = _regions(clusters, b, member, points, flow)
        return SceneMotion(
            labels=final,
            scene_flow=flow,
            objects=objects,
            camera_motion=camera_motion,
            method="vo-sf",
            seconds=time.perf_counter() - start,
        )

    def _camera_motion(self, curr_T_prev: Float64Array, level: Level, static: BoolMask) -> Float64Array | None:
        prev_T_curr = geometry.inverse(curr_T_prev)
        if self.camera == "moving" or (self.camera == "auto" and _exceeds_noise(prev_T_curr, level, static)):
            return prev_T_curr
        return None


def _paint(clusters: Clusters, prev_T_curr: Float64Array, points: Float32Array) -> tuple[LabelImage, Float32Array]:
    """(24, 4, 4) motions and (H, W, 3) points, NaN where missing -> clusters (H, W) and flow (H, W, 3)."""
    # Displacements, not positions: what does not move has a flow of exactly 0.
    displacement = (prev_T_curr - np.eye(4))[:, :3].reshape(COUNT, 12).astype(np.float32)
    member, flow = np.empty(points.shape[:2], np.int32), np.empty_like(points)
    for at in range(0, len(points), _ROWS):
        rows = slice(at, at + _ROWS)
        known = np.nan_to_num(points[rows])
        member[rows], soft = clusters.assign(known)
        blended = (soft @ displacement).reshape(*known.shape[:2], 3, 4)
        flow[rows] = (blended[..., :3] @ known[..., None])[..., 0] + blended[..., 3]
    flow[member == COUNT] = np.nan
    return member, flow


def _regions(
    clusters: Clusters, b: Float64Array, member: LabelImage, points: Float32Array, flow: Float32Array
) -> tuple[LabelImage, tuple[ObjectMotion, ...]]:
    """Moving clusters that touch are one object, whose motion is the rigid one nearest to its flow."""
    moving = b > MOVING
    _, group = connected_components(clusters.touching & moving[:, None] & moving, directed=False)
    labels = np.zeros(member.shape, np.int32)
    objects: list[ObjectMotion] = []
    for value in dict.fromkeys(group[moving]):
        table = np.append(moving & (group == value), False)
        mask = table[member]
        if not mask.any():
            continue
        labels[mask] = len(objects) + 1
        seen = points[mask].astype(np.float64)
        prev_T_curr, _ = geometry.kabsch(seen, seen + flow[mask])
        objects.append(
            ObjectMotion(
                id=len(objects) + 1,
                pixels=int(mask.sum()),
                score=float(np.clip(b[member[mask]].mean() / 2, 0, 1)),
                moving=True,
                center=seen.mean(0),
                prev_T_curr=prev_T_curr,
            )
        )
    return labels, tuple(objects)


def _exceeds_noise(prev_T_curr: Float64Array, level: Level, static: BoolMask) -> bool:
    """Whether a motion of the camera shows on static pixels (H, W): in the image, or in depth above its noise."""
    if not static.any():
        return False
    seen = level.points[static].astype(np.float64)
    carried = geometry.transform(prev_T_curr, seen)
    slide = np.linalg.norm(geometry.project(carried, level.camera) - geometry.project(seen, level.camera), axis=1)
    shift = np.linalg.norm(carried - seen, axis=1) / depth_sigma(seen[:, 2])
    return bool(np.nanmedian(slide) >= 0.7 or np.median(shift) >= 3)
