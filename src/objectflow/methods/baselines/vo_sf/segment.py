"""Segmentation of the clusters by their residuals under the camera motion: b from 0 (static) to 2 (moving)."""

from __future__ import annotations

import numpy as np

from objectflow import geometry
from objectflow.methods.baselines.vo_sf.clusters import COUNT, Clusters
from objectflow.methods.baselines.vo_sf.linearise import PHOTOMETRIC_WEIGHT
from objectflow.methods.baselines.vo_sf.pyramid import Level
from objectflow.methods.baselines.vo_sf.warp import splat_second
from objectflow.typing import Float64Array, LabelImage

MOVING, STATIC = 0.667, 0.333
"""Clusters with b above the first value move, with b below the second are static, and in between count as both."""
_EDGE = 0.3
"""Sum of the depth differences to the four neighbours above which a pixel lies on an edge and is ignored, metres."""
_OCCLUDED = 0.1
"""Decrease of depth at which a pixel's weight starts to fall, metres; at twice this, it counts as occluded."""
_SMOOTH, _DEPTH_PRIOR = 0.5, 0.15
"""Weights of the smoothness term and of the depth prior."""


def segment(
    first: Level, second: Level, clusters: Clusters, labels: LabelImage, first_T_second: Float64Array
) -> Float64Array:
    """Classify the clusters, given the camera motion.

    Args:
        first, second: the finest levels.
        clusters: of the first frame.
        labels: (H, W) cluster of each pixel, 24 where depth is missing.
        first_T_second: the camera motion, (4, 4).

    Returns:
        (24,) float64 b; 0 for clusters without pixels.
    """
    residuals = _residuals(first, splat_second(second, first_T_second), clusters, labels)
    speed = float(np.linalg.norm(geometry.se3_log(first_T_second)))
    return solve_labels(residuals, speed, clusters)


def _residuals(first: Level, warped: Level, clusters: Clusters, labels: LabelImage) -> Float64Array:
    """(24,) mean truncated residuals: weighted brightness plus depth relative to the cluster's depth."""
    depth = first.depth
    variation = np.full(depth.shape, np.inf, np.float32)
    inner = depth[1:-1, 1:-1]
    variation[1:-1, 1:-1] = sum(
        np.abs(shifted - inner) for shifted in (depth[2:, 1:-1], depth[:-2, 1:-1], depth[1:-1, 2:], depth[1:-1, :-2])
    )
    known = (depth > 0) & (warped.depth > 0) & (variation < _EDGE)
    nearer = depth - warped.depth
    ramp = np.clip(2 * _OCCLUDED - nearer, 0, None)
    weight = np.where(nearer < _OCCLUDED, 1, ramp) * known
    depth_error = np.where(nearer < _OCCLUDED, np.minimum(np.abs(nearer), 0.2), 1)
    gray_error = np.minimum(np.abs(first.gray - warped.gray), 0.5)
    size = np.maximum(np.bincount(labels.ravel(), minlength=COUNT + 1)[:COUNT], 1)
    mean_depth, mean_gray = (
        np.bincount(labels.ravel(), (weight * error).ravel(), COUNT + 1)[:COUNT] / size
        for error in (depth_error, gray_error)
    )
    distance = np.maximum(clusters.centers[:, 2], 1e-6)
    return np.asarray(np.where(clusters.used, PHOTOMETRIC_WEIGHT * mean_gray + mean_depth / distance, 0.0))


def solve_labels(residuals: Float64Array, speed: float, clusters: Clusters) -> Float64Array:
    """Compute (24,) b from (24,) residuals by linear least squares with smoothness and a depth prior.

    Args:
        residuals: (24,) mean residuals.
        speed: norm of the camera's twist (m, rad), which raises the limits.
        clusters: of the first frame.
    """
    used = clusters.used
    known = np.sort(residuals[used])
    median = known[len(known) // 2]
    unit = max(0.007, min(0.015 * (1 + 10 * speed), float(median)))
    low, high = (1 + 10 * speed) * unit, (2 + 10 * speed) * unit
    target = np.clip((residuals - low) / (high - low), 0, 2)
    # The confidence is lowest midway between the two limits.
    confidence = np.sqrt(((residuals - (low + high) / 2) / ((high - low) / 2)) ** 2 + 1)
    z = clusters.centers[:, 2].astype(np.float64)
    far = np.exp(0.75 * z[used].min() + 0.25 * z[used].max())
    prior = _DEPTH_PRIOR * np.maximum(np.exp(np.minimum(z, 50)) - far, 0)

    rows = [np.diag(confidence + prior)]
    values = [confidence * target]
    for a, b in zip(*np.nonzero(np.triu(clusters.connected, 1)), strict=True):
        row = np.zeros((1, COUNT))
        row[0, a], row[0, b] = _SMOOTH, -_SMOOTH
        rows.append(row)
        values.append(np.zeros(1))
    b = np.linalg.lstsq(np.concatenate(rows), np.concatenate(values), rcond=None)[0]
    return np.where(used, b, 0.0)
