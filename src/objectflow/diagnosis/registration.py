"""Whether colour and depth lie on the same pixels: where depth steps, colour should change too."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np

from objectflow.frame import RgbdFrame
from objectflow.typing import BoolMask, Float32Array, IndexArray, UInt8Array

MIN_EDGES = 150
"""Pixels on depth edges; with fewer nothing can be told."""


class Offset(NamedTuple):
    """Where colour's edges lie, seen from depth's.

    Attributes:
        du, dv: pixels to shift depth by, right and down, to fit the colour.
        gain: how much more colour changes under the shifted edges than under the edges as they are; 1 = no more.
        prominence: how far the best shift stands out from all others, in their standard deviations.
    """

    du: int
    dv: int
    gain: float
    prominence: float


def estimate_offset(frame: RgbdFrame, *, reach: float = 0.04) -> Offset | None:
    """The shift of depth under which its steps fall on changes of colour.

    Args:
        frame: colour and depth to compare.
        reach: greatest shift, as a share of the image's width.

    Returns:
        The best shift, or None if there are too few depth edges.
    """
    limit = max(3, round(reach * frame.camera.width))
    change = _color_change(frame.color)
    edges = [_inner(edge, limit) for edge in _depth_edges(frame.depth)]
    if sum(len(rows) for rows, _ in edges) < MIN_EDGES:
        return None
    shifts = np.arange(-limit, limit + 1)
    score = np.zeros((len(shifts), len(shifts)))
    for (rows, columns), gradient in zip(edges, change, strict=True):
        for i, dv in enumerate(shifts):
            score[i] += gradient[(rows + dv)[:, None], columns[:, None] + shifts].sum(axis=0)
    best = np.unravel_index(score.argmax(), score.shape)
    at_zero = score[limit, limit]
    return Offset(
        du=int(shifts[best[1]]),
        dv=int(shifts[best[0]]),
        gain=float(score[best] / max(at_zero, 1e-9)),
        prominence=float((score[best] - score.mean()) / max(score.std(), 1e-9)),
    )


def alignment(frame: RgbdFrame) -> float:
    """Mean change of colour, 0..1, on the steps of depth as they lie; NaN without any."""
    change = _color_change(frame.color)
    values = [gradient[edge] for edge, gradient in zip(_depth_edges(frame.depth), change, strict=True)]
    joined = np.concatenate(values)
    return float(joined.mean()) if len(joined) else float("nan")


def _color_change(color: UInt8Array) -> tuple[Float32Array, Float32Array]:
    """How much colour changes along x and along y, 0..1: beyond a strong edge, stronger does not count for more."""
    lab = cv2.GaussianBlur(cv2.cvtColor(color, cv2.COLOR_RGB2LAB), (0, 0), 1.0).astype(np.float32)
    along = [np.abs(cv2.Sobel(lab, cv2.CV_32F, dx, dy, scale=1 / 8)).max(axis=2) for dx, dy in ((1, 0), (0, 1))]
    limit = max(2.0, float(np.percentile(np.maximum(*along), 95)))
    return tuple(np.minimum(one / limit, 1).astype(np.float32) for one in along)


def _depth_edges(depth: Float32Array) -> tuple[BoolMask, BoolMask]:
    """Pixels on the near side of a step along x, and along y. Steps beside missing depth are left out: they wander."""
    out = []
    for axis in (1, 0):
        ahead, behind = np.roll(depth, -1, axis), np.roll(depth, 1, axis)
        step = np.zeros(depth.shape, bool)
        for other in (ahead, behind):
            step |= (depth > 0) & (other > 0) & (other - depth > 0.04 * depth + 0.01)
        step[:, [0, -1]] = False
        step[[0, -1]] = False
        out.append(step)
    return out[0], out[1]


def _inner(edge: BoolMask, margin: int) -> tuple[IndexArray, IndexArray]:
    """Rows and columns of edge pixels that stay in the image under every shift."""
    inside = np.zeros_like(edge)
    inside[margin:-margin, margin:-margin] = edge[margin:-margin, margin:-margin]
    rows, columns = np.nonzero(inside)
    return rows, columns
