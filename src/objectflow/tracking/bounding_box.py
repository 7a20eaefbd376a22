"""The smallest oriented box around points."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from scipy.spatial import ConvexHull

from objectflow.typing import Float64Array

MAX_FACETS = 400
"""Largest number of hull facets that are tried as a side of the box, the largest ones first."""
_MIN_POINTS = 4


class OrientedBox(NamedTuple):
    """A box.

    Attributes:
        object_T_box: (4, 4) its centre and its axes in the object frame.
        extent: (3,) metres: full edge lengths along its axes, largest first.
    """

    object_T_box: Float64Array
    extent: Float64Array


def smallest_box(points: Float64Array) -> OrientedBox | None:
    """The smallest of the boxes with a side on a facet of the convex hull.

    Args:
        points: (N, 3) metres in the object frame.

    Returns:
        None for fewer than four points.
    """
    if len(points) < _MIN_POINTS:
        return None
    middle = points.mean(axis=0)
    # Joggled input, as a surface seen from the front may be flat.
    hull = ConvexHull(points - middle, qhull_options="QJ Pp")
    corners = hull.points[hull.vertices]
    edges = hull.points[hull.simplices]
    normals = np.cross(edges[:, 1] - edges[:, 0], edges[:, 2] - edges[:, 0])
    areas = np.linalg.norm(normals, axis=1)
    best: tuple[float, Float64Array, Float64Array, Float64Array] | None = None
    for index in np.argsort(-areas, kind="stable")[:MAX_FACETS]:
        if areas[index] <= 0:
            continue
        normal = normals[index] / areas[index]
        first = np.cross(normal, np.eye(3)[np.abs(normal).argmin()])
        first /= np.linalg.norm(first)
        axes = np.stack([first, np.cross(normal, first), normal])
        # Rotating calipers in the plane of the facet.
        flat = (corners @ axes[:2].T).astype(np.float32)
        angle = np.radians(cv2.minAreaRect(flat)[2])
        cosine, sine = np.cos(angle), np.sin(angle)
        axes[:2] = np.array([[cosine, sine], [-sine, cosine]]) @ axes[:2]
        along = corners @ axes.T
        lower, upper = along.min(axis=0), along.max(axis=0)
        volume = float(np.prod(np.maximum(upper - lower, 1e-6)))
        if best is None or volume < best[0]:
            best = volume, axes, lower, upper
    if best is None:
        return None
    _, axes, lower, upper = best
    order = np.argsort(lower - upper, kind="stable")
    axes, lower, upper = axes[order], lower[order], upper[order]
    if np.linalg.det(axes) < 0:
        axes[2], lower[2], upper[2] = -axes[2], -upper[2], -lower[2]
    object_T_box = np.eye(4)
    object_T_box[:3, :3] = axes.T
    object_T_box[:3, 3] = middle + axes.T @ ((lower + upper) / 2)
    return OrientedBox(object_T_box, upper - lower)
