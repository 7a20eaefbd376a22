"""Robust camera motion, and motions of the clusters, each estimated from coarse to fine."""

from __future__ import annotations

import numpy as np

from objectflow import geometry
from objectflow.methods.baselines.vo_sf.clusters import COUNT, Clusters
from objectflow.methods.baselines.vo_sf.linearise import constraints, gradients, uncertainty_weights
from objectflow.methods.baselines.vo_sf.pyramid import Level
from objectflow.methods.baselines.vo_sf.segment import MOVING, STATIC
from objectflow.methods.baselines.vo_sf.solve import solve_twist
from objectflow.methods.baselines.vo_sf.warp import splat_second, warp_second
from objectflow.typing import Float32Array, Float64Array

_WARPS = 3
_SMALL_TWIST = 0.04
"""Norm of a twist (m, rad) below which a level has converged."""
_CAUCHY_CAMERA, _CAUCHY_MOVING, _CAUCHY_STATIC = 16.0, 1.0, 0.25
_MIN_SOFT_LABEL = 0.2
"""Minimum soft label with which a pixel contributes to a cluster's motion."""


def robust_odometry(first: list[Level], second: list[Level]) -> Float64Array:
    """Estimate the motion of most of the image: `first_T_second` (4, 4).

    The second frame is warped forward by the current estimate; a strong Cauchy loss suppresses moving objects.
    """
    first_T_second = np.eye(4)
    for a, b in zip(reversed(first), reversed(second), strict=True):
        for _ in range(_WARPS):
            warped = b if (first_T_second == np.eye(4)).all() else splat_second(b, first_T_second)
            level = gradients(a, warped)
            # Weighting by depth balances near and far pixels, which have smaller displacements.
            J, r = constraints(level, level.middle.depth, level.middle.depth)
            twist = solve_twist(J[level.usable], r[level.usable], None, _CAUCHY_CAMERA, least_squares_start=False)
            first_T_second = geometry.se3_exp(twist) @ first_T_second
            if np.linalg.norm(twist) < _SMALL_TWIST:
                break
    return first_T_second


def cluster_motions(
    first: list[Level], second: list[Level], clusters: Clusters, b: Float64Array
) -> tuple[Float64Array, Float64Array]:
    """Estimate the camera motion from the static clusters, and the motion of each moving cluster.

    Args:
        first, second: pyramids, finest first.
        clusters: of the first frame.
        b: (24,) from `segment`; a cluster that is neither static nor moving contributes to the camera motion and
            also has its own motion.

    Returns:
        `first_T_second` of the camera (4, 4) and of each cluster (24, 4, 4), the camera's for static clusters.
    """
    static, moving = b <= MOVING, b >= STATIC
    camera, motions = np.eye(4), np.tile(np.eye(4), (COUNT, 1, 1))
    confidence = np.append(np.where(static, np.clip(1 - b, 0, None), 1.0), 0.0).astype(np.float32)
    for number, (a, second_level) in enumerate(zip(reversed(first), reversed(second), strict=True)):
        labels, soft = clusters.assign(a.points)
        warped = second_level if number == 0 else warp_second(second_level, a, blend(soft, geometry.inverse(motions)))
        level = gradients(a, warped)
        J, r = constraints(level, *uncertainty_weights(level, confidence[labels]))
        members = (soft > _MIN_SOFT_LABEL) & level.usable[..., None]

        repeats = members[..., static].sum(-1).astype(np.float32)
        mask = repeats > 0
        twist = solve_twist(J[mask], r[mask], repeats[mask], _CAUCHY_STATIC, least_squares_start=True)
        step = geometry.se3_exp(twist)
        camera = step @ camera
        motions[static & ~moving] = step @ motions[static & ~moving]
        if number == 0:
            continue  # The coarsest level has too few pixels per cluster.
        for k in np.flatnonzero(moving & clusters.used):
            mask = members[..., k]
            twist = solve_twist(J[mask], r[mask], None, _CAUCHY_MOVING, least_squares_start=True)
            motions[k] = geometry.se3_exp(twist) @ motions[k]
    return camera, motions


def blend(soft: Float32Array, second_T_first: Float64Array) -> Float32Array:
    """Soft labels (..., 24) and motions (24, 4, 4) -> (..., 3, 4): weighted mean of the motion matrices per pixel.

    A mean of rotation matrices is only approximately a rotation, which suffices for similar motions.
    """
    matrices = second_T_first[:, :3].reshape(COUNT, 12).astype(np.float32)
    return (soft @ matrices).reshape(*soft.shape[:-1], 3, 4)
