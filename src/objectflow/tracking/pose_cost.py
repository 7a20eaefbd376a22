"""Comparison of poses: whether a registered pose explains a frame better than the pose that registration began with.

Registration of a small, smooth or symmetric object always finds a pose, which slides along the directions that the
image does not constrain. A registered pose is therefore kept only where it lowers the cost by more than noise does.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np

from objectflow import geometry
from objectflow.alignment.registration import RegistrationSettings, RegistrationSource, RegistrationTarget
from objectflow.settings import Settings, setting
from objectflow.typing import Float32Array, Float64Array


@dataclass(frozen=True)
class PoseCostSettings(Settings):
    """The cost of a pose, and the gain that a registered pose needs."""

    min_gain: float = setting(0.1, minimum=0, maximum=1)
    """Minimum relative decrease of the mean cost at which a registered pose replaces the given one."""
    gray_noise: float = setting(8.0, above=0)
    """Grey levels: standard deviation of a grey residual."""
    chroma_noise: float = setting(8.0, above=0)
    """CIELAB units: standard deviation of a residual in a colour-opponent channel."""
    max_sigmas: float = setting(5.0, above=0)
    """Standard deviations at which a residual is truncated."""


def is_better(costs: Float64Array, settings: PoseCostSettings) -> bool:
    """Whether the second of two costs is lower than the first by `min_gain`."""
    return bool(costs[1] < (1 - settings.min_gain) * costs[0])


class Chroma(NamedTuple):
    """The colour-opponent channels of CIELAB around 0.

    Attributes:
        image: (H, W, 2) float32 of the image that points are compared with.
        points: (N, 2) float32 of the points.
    """

    image: Float32Array
    points: Float32Array


def pose_costs(
    target: RegistrationTarget,
    source: RegistrationSource,
    poses: Sequence[Float64Array],
    registration: RegistrationSettings,
    settings: PoseCostSettings,
    chroma: Chroma | None = None,
) -> Float64Array:
    """The mean cost of the same points at several poses.

    The cost of a point is its squared distance to the target's surface plus its squared residual of colour, both in
    standard deviations and truncated. Points are compared that lie on the target's surface image at every pose and
    that are visible at one of them at least.

    Args:
        target: the image that the points are compared with.
        source: the points.
        poses: (4, 4) each, from the frame of the points to that of the target.
        registration: provides the weight of colour and the limit from which a point is hidden.
        settings: see there.
        chroma: colours of both; without them, grey levels alone are compared.

    Returns:
        (K,) the cost of each pose; zeros where no point can be compared.
    """
    size = np.array([target.camera.width, target.camera.height])
    grays = source.grays[-1]
    compared, visible = np.ones(len(grays), bool), np.zeros(len(grays), bool)
    residuals = []
    for pose in poses:
        points = geometry.transform(pose, source.points.astype(np.float64))
        pixels = np.nan_to_num(geometry.project(points, target.camera), nan=-2, posinf=-2, neginf=-2).clip(-2, 1e6)
        at = np.rint(pixels).astype(np.int64)
        inside = (at >= 0).all(axis=1) & (at < size).all(axis=1) & (points[:, 2] > 0)
        column, row = np.where(inside, at.T, 0)
        offset = points - target.points[row, column]
        along = (offset * target.normals[row, column]).sum(axis=1)
        along = np.where(np.isfinite(along), along, offset[:, 2])
        sigma = target.noise.sigma(points[:, 2])
        compared &= inside & np.isfinite(along)
        visible |= offset[:, 2] < registration.inlier_sigmas * sigma + registration.hidden_margin
        u, v = pixels.T.astype(np.float32)
        shade = target.shades[-1][..., 0]
        seen = cv2.remap(shade, u[None], v[None], cv2.INTER_LINEAR)[0] if len(grays) else grays
        tint = np.zeros(len(grays))
        if chroma is not None and len(grays):
            there = cv2.remap(chroma.image, u[None], v[None], cv2.INTER_LINEAR)[0]
            tint = np.square((there - chroma.points) / settings.chroma_noise).sum(axis=1)
        residuals.append((along / sigma, (seen - grays) / settings.gray_noise, tint))
    used = compared & visible
    if not used.any():
        return np.zeros(len(poses))
    limit = settings.max_sigmas**2
    costs = []
    for depth, gray, tint in residuals:
        change = gray[used] - np.median(gray[used])  # exposure may have changed
        color = np.minimum(change**2 + tint[used], limit)
        cost = np.minimum(depth[used] ** 2, limit) + registration.color_weight * color
        costs.append(float(cost.mean()))
    return np.array(costs)
