"""Geometric clusters: k-means on the points, which clusters touch, and soft labels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from objectflow.methods.baselines.vo_sf.pyramid import Level
from objectflow.typing import BoolMask, Float32Array, LabelImage

COUNT = 24
"""Clusters."""
_ITERATIONS = 9
_CONVERGED = 1e-2
"""Metres: k-means stops when no coordinate of a centre moves further."""
_TOUCH = 0.03 * 120
"""Metres times rows: adjacent pixels closer than this over the rows of the image connect their clusters."""
_SOFTNESS = 100.0
"""Per square metre: how fast a soft label falls off (k_smooth)."""
_CUT = 6.0
"""Soft labels below exp(-6) are 0."""
_PART = 1 << 13
"""Points whose distances to all clusters are found at once."""


@dataclass(frozen=True, eq=False)
class Clusters:
    """The clusters of the first frame.

    Attributes:
        centers: (24, 3) float32 metres, camera frame.
        used: (24,) bool: False where no pixel belongs to the cluster.
        touching: (24, 24) bool, symmetric, true on the diagonal.
    """

    centers: Float32Array
    used: BoolMask
    touching: BoolMask

    def labels(self, points: Float32Array) -> LabelImage:
        """(..., 3) points, 0 where missing -> (...) int32: the nearest cluster, 24 where depth is missing."""
        flat = points.reshape(-1, 3)
        nearest = np.concatenate([_distance2(flat[i], self.centers, self.used).argmin(-1) for i in _parts(len(flat))])
        return np.where(flat[:, 2] > 0, nearest, COUNT).astype(np.int32).reshape(points.shape[:-1])

    def assign(self, points: Float32Array) -> tuple[LabelImage, Float32Array]:
        """`labels`, and soft labels: (..., 24) float32 that sum to 1, all 0 where depth is missing.

        A pixel near the border of its cluster also belongs to the touching clusters, the more the nearer it is to
        them: exp(-100 |d_own^2 - d_l^2|).
        """
        flat = points.reshape(-1, 3)
        labels, soft = np.empty(len(flat), np.int32), np.empty((len(flat), COUNT), np.float32)
        # Row 24 of the table, for pixels without depth, has no cluster at all.
        table = np.concatenate([self.touching, np.zeros((1, COUNT), bool)])
        for part in _parts(len(flat)):
            distance2 = _distance2(flat[part], self.centers, self.used)
            nearest = distance2.argmin(-1)
            exponent = distance2
            with np.errstate(over="ignore", invalid="ignore"):  # where depth is absurd
                exponent -= np.take_along_axis(distance2, nearest[:, None], -1)
                exponent *= np.float32(_SOFTNESS)
            labels[part] = np.where(flat[part, 2] > 0, nearest, COUNT)
            weights = np.exp(-np.minimum(exponent, np.float32(_CUT)))
            weights *= table[labels[part]] & (exponent < _CUT)
            soft[part] = weights / np.maximum(weights.sum(-1, keepdims=True), np.float32(1e-6))
        return labels.reshape(points.shape[:-1]), soft.reshape(*points.shape[:-1], COUNT)


def cluster(levels: list[Level]) -> Clusters:
    """Cluster the first frame (levels finest first): k-means at half the resolution, connectivity at the finest."""
    # Halving drops measured pixels that stand alone; an image of nothing else is clustered as it is.
    centers, used = _k_means(levels[1] if levels[1].depth.any() else levels[0])
    clusters = Clusters(centers, used, np.eye(COUNT, dtype=bool))
    touching = _connectivity(levels[0], clusters.labels(levels[0].points))
    return Clusters(centers, used, touching)


def _parts(count: int) -> list[slice]:
    """Parts of a list that are short enough for the processor's cache; at least one, if empty."""
    return [slice(at, at + _PART) for at in range(0, max(count, 1), _PART)]


def _distance2(points: Float32Array, centers: Float32Array, used: BoolMask) -> Float32Array:
    """(N, 3) and (24, 3) -> (N, 24) square metres, infinite for clusters without pixels.

    About a common origin amid the points, the products of single precision keep their digits.
    """
    origin = centers[used].mean(0)
    p, c = points - origin, centers - origin
    with np.errstate(over="ignore", invalid="ignore"):  # where depth is absurd
        out = p @ (-2 * c.T)
        out += (p**2).sum(-1, keepdims=True)
    out += np.where(used, (c**2).sum(-1), np.float32(np.inf))
    return np.asarray(out)


def _k_means(level: Level) -> tuple[Float32Array, BoolMask]:
    """Lloyd's iterations from seeds on a fixed grid; nothing is random."""
    rows, columns = level.depth.shape
    steps = int(np.ceil(np.sqrt(COUNT)))
    index = np.arange(COUNT)
    seed_u = np.rint((index + 1) * columns / (COUNT + 1)).astype(int)
    # The authors' image rows count from the bottom.
    seed_v = rows - 1 - np.rint((index % steps + 1) * rows / (steps + 1)).astype(int)
    v, u = np.nonzero(level.depth > 0)
    points = level.points[v, u]
    member = ((u[:, None] - seed_u) ** 2 + (v[:, None] - seed_v) ** 2).argmin(1)

    centers, used = np.zeros((COUNT, 3), np.float32), np.zeros(COUNT, bool)
    camera = level.camera
    for k in range(COUNT):
        depths = points[member == k, 2]
        if len(depths):
            # A median is the depth of something; a mean may hang between two surfaces.
            z = np.partition(depths, len(depths) // 2)[len(depths) // 2]
            centers[k] = (seed_u[k] - camera.cx) / camera.fx * z, (seed_v[k] - camera.cy) / camera.fy * z, z
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
    """Clusters touch where adjacent pixels of them are closer than 3.6 m / rows along the image axis and in depth."""
    touching = np.eye(COUNT + 1, dtype=bool)
    limit = (_TOUCH / level.depth.shape[0]) ** 2
    for image_axis, coordinate in ((0, 1), (1, 0)):
        step = np.diff(level.points[..., [coordinate, 2]], axis=image_axis)
        near = (step**2).sum(-1) < limit
        here, there = (labels[:-1], labels[1:]) if image_axis == 0 else (labels[:, :-1], labels[:, 1:])
        touching[here[near], there[near]] = True
        touching[there[near], here[near]] = True
    return touching[:COUNT, :COUNT]
