"""Geometric clusters: k-means on the points, connectivity, and soft labels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from objectflow import geometry
from objectflow.methods.baselines.vo_sf.pyramid import Level
from objectflow.typing import BoolMask, Float32Array, LabelImage

COUNT = 24
"""Number of clusters."""
_ITERATIONS = 9
_CONVERGED = 1e-2
"""Largest change of a centre's coordinates at which k-means stops, metres."""
_MAX_GAP = 0.03 * 120
"""Largest distance of adjacent pixels that connects their clusters, times the number of image rows, metres."""
_SOFTNESS = 100.0
"""Decay of soft labels with the difference of squared distances (k_smooth), 1/m^2."""
_MAX_EXPONENT = 6.0
"""Soft labels below exp(-6) are set to 0."""
_CHUNK = 1 << 13
"""Number of points per chunk."""


@dataclass(frozen=True, eq=False)
class Clusters:
    """The clusters of the first frame.

    Attributes:
        centers: (24, 3) float32 metres, camera frame.
        used: (24,) bool: whether a cluster has pixels.
        connected: (24, 24) bool, symmetric, true on the diagonal.
    """

    centers: Float32Array
    used: BoolMask
    connected: BoolMask

    def labels(self, points: Float32Array) -> LabelImage:
        """(..., 3) points, 0 where missing -> (...) int32: the nearest cluster, or 24 where depth is missing."""
        flat = points.reshape(-1, 3)
        nearest = np.concatenate([_distance2(flat[i], self.centers, self.used).argmin(-1) for i in _chunks(len(flat))])
        return np.where(flat[:, 2] > 0, nearest, COUNT).astype(np.int32).reshape(points.shape[:-1])

    def assign(self, points: Float32Array) -> tuple[LabelImage, Float32Array]:
        """`labels`, and soft labels (..., 24) float32 that sum to 1, or all 0 where depth is missing.

        Pixels near the border of their cluster also belong to connected clusters, with weights
        exp(-100 |d_own^2 - d_l^2|).
        """
        flat = points.reshape(-1, 3)
        labels, soft = np.empty(len(flat), np.int32), np.empty((len(flat), COUNT), np.float32)
        # Row 24, for pixels without depth, is connected to no cluster.
        connected = np.concatenate([self.connected, np.zeros((1, COUNT), bool)])
        for chunk in _chunks(len(flat)):
            distance2 = _distance2(flat[chunk], self.centers, self.used)
            nearest = distance2.argmin(-1)
            exponent = distance2
            with np.errstate(over="ignore", invalid="ignore"):  # For implausible depth.
                exponent -= np.take_along_axis(distance2, nearest[:, None], -1)
                exponent *= np.float32(_SOFTNESS)
            labels[chunk] = np.where(flat[chunk, 2] > 0, nearest, COUNT)
            weights = np.exp(-np.minimum(exponent, np.float32(_MAX_EXPONENT)))
            weights *= connected[labels[chunk]] & (exponent < _MAX_EXPONENT)
            soft[chunk] = weights / np.maximum(weights.sum(-1, keepdims=True), np.float32(1e-6))
        return labels.reshape(points.shape[:-1]), soft.reshape(*points.shape[:-1], COUNT)


def cluster(levels: list[Level]) -> Clusters:
    """Cluster the first frame (levels finest first): k-means at half the resolution, connectivity at the finest."""
    # Halving drops isolated pixels; a frame with no others is clustered at full resolution.
    centers, used = _k_means(levels[1] if levels[1].depth.any() else levels[0])
    clusters = Clusters(centers, used, np.eye(COUNT, dtype=bool))
    connected = _connectivity(levels[0], clusters.labels(levels[0].points))
    return Clusters(centers, used, connected)


def _chunks(count: int) -> list[slice]:
    """Chunks that fit into the processor's cache; at least one, even if empty."""
    return [slice(start, start + _CHUNK) for start in range(0, max(count, 1), _CHUNK)]


def _distance2(points: Float32Array, centers: Float32Array, used: BoolMask) -> Float32Array:
    """Squared distances (N, 24) in m^2 of (N, 3) points to (24, 3) centres, infinite for clusters without pixels.

    Coordinates are relative to the mean centre, which preserves precision in float32.
    """
    origin = centers[used].mean(0)
    p, c = points - origin, centers - origin
    with np.errstate(over="ignore", invalid="ignore"):  # For implausible depth.
        out = p @ (-2 * c.T)
        out += (p**2).sum(-1, keepdims=True)
    out += np.where(used, (c**2).sum(-1), np.float32(np.inf))
    return np.asarray(out)


def _k_means(level: Level) -> tuple[Float32Array, BoolMask]:
    """Lloyd's algorithm from seeds on a fixed grid; deterministic."""
    rows, columns = level.depth.shape
    steps = int(np.ceil(np.sqrt(COUNT)))
    index = np.arange(COUNT)
    seed_u = np.rint((index + 1) * columns / (COUNT + 1)).astype(int)
    # The authors' image rows start at the bottom.
    seed_v = rows - 1 - np.rint((index % steps + 1) * rows / (steps + 1)).astype(int)
    v, u = np.nonzero(level.depth > 0)
    points = level.points[v, u]
    member = ((u[:, None] - seed_u) ** 2 + (v[:, None] - seed_v) ** 2).argmin(1)

    centers, used = np.zeros((COUNT, 3), np.float32), np.zeros(COUNT, bool)
    for k in range(COUNT):
        depths = points[member == k, 2]
        if len(depths):
            # The median lies on a surface, while the mean may lie between two.
            z = np.partition(depths, len(depths) // 2)[len(depths) // 2]
            centers[k] = geometry.back_project_pixels(np.array([seed_u[k], seed_v[k]]), z, level.camera)
            used[k] = True

    for _ in range(_ITERATIONS):
        member = _distance2(points, centers, used).argmin(1)
        count = np.bincount(member, minlength=COUNT)
        sums = np.stack([np.bincount(member, points[:, axis], COUNT) for axis in range(3)], axis=1)
        used = count > 0
        moved = np.where(used[:, None], sums / np.maximum(count, 1)[:, None], centers).astype(np.float32)
        step = np.abs(moved - centers).max()
        centers = moved
        if step < _CONVERGED:
            break
    return centers, used


def _connectivity(level: Level, labels: LabelImage) -> BoolMask:
    """Connect clusters that have adjacent pixels closer than 3.6 m / rows along the image axis and in depth."""
    connected = np.eye(COUNT + 1, dtype=bool)
    limit = (_MAX_GAP / level.depth.shape[0]) ** 2
    for image_axis, coordinate in ((0, 1), (1, 0)):
        step = np.diff(level.points[..., [coordinate, 2]], axis=image_axis)
        near = (step**2).sum(-1) < limit
        a, b = (labels[:-1], labels[1:]) if image_axis == 0 else (labels[:, :-1], labels[:, 1:])
        connected[a[near], b[near]] = True
        connected[b[near], a[near]] = True
    return connected[:COUNT, :COUNT]
