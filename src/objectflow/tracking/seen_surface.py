"""The surface of an object that one frame shows: its points and its colours."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np

from objectflow import geometry
from objectflow.frame import RgbdFrame
from objectflow.geometry.camera import Camera
from objectflow.typing import BoolMask, Float64Array, UInt8Array

_BINS = (4, 16, 16)
"""Histogram bins of lightness, which light changes, and of the two colour-opponent channels of CIELAB."""


class SeenSurface(NamedTuple):
    """Visible surface of an object: (N, 3) metres in the current camera frame, and its colours' histogram."""

    points: Float64Array
    colors: Float64Array


def seen_surface(frame: RgbdFrame, mask: BoolMask, max_points: int) -> SeenSurface:
    """The surface of a mask, of which points are subsampled evenly."""
    rows, columns = np.nonzero(mask & frame.valid)
    colors = color_histogram(frame.color[rows, columns])
    if len(rows) > max_points:
        pick = np.linspace(0, len(rows) - 1, max_points).astype(int)
        rows, columns = rows[pick], columns[pick]
    depth = frame.depth[rows, columns].astype(np.float64)
    return SeenSurface(geometry.back_project_pixels(np.stack([columns, rows], axis=1), depth, frame.camera), colors)


def color_histogram(colors: UInt8Array) -> Float64Array:
    """The normalised histogram of RGB colours (N, 3) in CIELAB."""
    if not len(colors):
        return np.zeros(_BINS[0] * _BINS[1] * _BINS[2])
    lab = cv2.cvtColor(colors.reshape(1, -1, 3), cv2.COLOR_RGB2LAB)
    counts, _ = np.histogramdd(lab[0].astype(np.float64), bins=_BINS, range=((0, 256), (64, 192), (64, 192)))
    return np.asarray(counts.ravel() / max(1.0, counts.sum()))


def footprint_overlap(a: Float64Array, b: Float64Array, camera: Camera, cells: int) -> float:
    """Intersection over union of the grid cells that two point sets (N, 3), camera frame, project into.

    Args:
        a, b: the point sets.
        camera: projects them.
        cells: number of cells across the image width.
    """
    cell = camera.width / cells
    footprints = []
    for points in (a, b):
        pixels = geometry.project(points[points[:, 2] > 0], camera)
        footprints.append({tuple(index) for index in np.floor((pixels + 0.5) / cell).astype(int).tolist()})
    union = len(footprints[0] | footprints[1])
    return len(footprints[0] & footprints[1]) / union if union else 0.0
