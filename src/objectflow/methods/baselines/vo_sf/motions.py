"""The camera's robust motion, and then one motion a cluster, each from the coarsest level to the finest."""

from __future__ import annotations

import numpy as np

from objectflow import geometry
from objectflow.methods.baselines.vo_sf.clusters import COUNT, Clusters
from objectflow.methods.baselines.vo_sf.linearise import constraints, gradients, uncertainty_weights
from objectflow.methods.baselines.vo_sf.pyramid import Level
from objectflow.methods.baselines.vo_sf.segment import MOVING, STATIC
from objectflow.methods.baselines.vo_sf.solve import solve_twist
from objectflow.methods.baselines.vo_sf.warp import fetch_second, splat_second
from objectflow.typing import Float32Array, Float64Array

_WARPS = 3
_SMALL_TWIST = 0.04
"""A level is done when its last twist (m, rad) is shorter."""
_CAUCHY_CAMERA, _CAUCHY_MOVING, _CAUCHY_STATIC = 16.0, 1.0, 0.25
_BELONGS = 0.2
"""A pixel helps to find the motions of all clusters of which it has a larger soft label."""


def robust_odometry(first: list[Level], second: list[Level]) -> Float64Array:
    """The motion that most of the image follows: `first_T_second` (4, 4).

    The second frame is thrown onto the first by the motion so far; a strong Cauchy penalty silences what moves.
    """
    first_T_second = np.eye(4)
    for a, b in zip(reversed(first), reversed(second), strict=True):
        for _ in range(_WARPS):
            warped = b if (first_T_second == np.eye(4)).all() else splat_second(b, first_T_second)
            level = gradients(a, warped)
            # Depth as a weight keeps the balance of near and far, whose pixels move less.
            J, r = constraints(level, level.middle.depth, level.middle.depth)
            twist = solve_twist(J[level.usable], r[level.usable], None, _CAUCHY_CAMERA, plain_start=False)
            first_T_second = geometry.se3_exp(twist) @ first_T_second
            if np.linalg.norm(twist) < _SMALL_TWIST:
                break
    return first_T_second


def cluster_motions(
    first: list[Level], second: list[Level], clusters: Clusters, b: Float64Array
) -> tuple[Float64Array, Float64Array]:
    """The camera's motion from the static clusters, and each moving cluster's own.

    Args:
        first, second: pyramids, finest first.
        clusters: of the first frame.
        b: (24,) from `segment`; a cluster that is neither static nor moving helps to find the camera's motion and
            gets one of its own.

    Returns:
        `first_T_second` of the camera (4, 4), and of each cluster (24, 4, 4): the camera's for static ones.
    """
    static, moving = b <= MOVING, b >= STATIC
    camera, own = np.eye(4), np.tile(np.eye(4), (COUNT, 1, 1))
    trust = np.append(np.where(static, np.clip(1 - b, 0, None), 1.0), 0.0).astype(np.float32)
    for number, (a, second_level) in enumerate(zip(reversed(first), reversed(second), strict=True)):
        labels, soft = clusters.assign(a.points)
        warped = second_level if number == 0 else fetch_second(second_level, a, blend(soft, geometry.inverse(own)))
        level = gradients(a, warped)
        J, r = constraints(level, *uncertainty_weights(level, trust[labels]))
        belongs = (soft > _BELONGS) & level.usable[..., None]

        repeats = belongs[..., static].sum(-1).astype(np.float32)
        here = repeats > 0
        twist = solve_twist(J[here], r[here], repeats[here], _CAUCHY_STATIC, plain_start=True)
        step = geometry.se3_exp(twist)
        camera = step @ camera
        own[static & ~moving] = step @ own[static & ~moving]
        if number == 0:
            continue  # too few pixels for single clusters
        for k in np.flatnonzero(moving & clusters.used):
            here = belongs[..., k]
            twist = solve_twist(J[here], r[here], None, _CAUCHY_MOVING, plain_start=True)
            own[k] = geometry.se3_exp(twist) @ own[k]
    return camera, own


def blend(soft: Float32Array, second_T_first: Float64Array) -> Float32Array:
    """Soft labels (..., 24) and motions (24, 4, 4) -> (..., 3, 4): each pixel's mean of its clusters' matrices.

    A mean of rotations is not quite one; between neighbouring clusters the difference does not count.
    """
    table = second_T_first[:, :3].reshape(COUNT, 12).astype(np.float32)
    return (soft @ table).reshape(*soft.shape[:-1], 3, 4)
