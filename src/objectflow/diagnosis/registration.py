"""Registration of depth to colour, measured by how well depth edges coincide with colour edges."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np

from objectflow.diagnosis.settings import RegistrationCheckSettings
from objectflow.frame import RgbdFrame
from objectflow.typing import BoolMask, Float32Array, IndexArray, UInt8Array

DEFAULTS = RegistrationCheckSettings()


class Offset(NamedTuple):
    """Shift of depth that aligns its edges with those of colour.

    Attributes:
        du, dv: shift in pixels, right and down.
        gain: ratio of the colour gradient on the shifted edges to that on the original edges.
        prominence: z-score of the best shift's gradient among all shifts.
    """

    du: int
    dv: int
    gain: float
    prominence: float


def estimate_offset(frame: RgbdFrame, settings: RegistrationCheckSettings = DEFAULTS) -> Offset | None:
    """Find the shift of depth that maximises the colour gradient on the depth edges.

    Args:
        frame: colour and depth to compare.
        settings: `min_edges` and `max_shift` apply.

    Returns:
        The best shift, or None if there are too few depth edges.
    """
    limit = max(3, round(settings.max_shift * frame.camera.width))
    gradients = _color_gradients(frame.color)
    edges = [_inner(edge, limit) for edge in find_depth_edges(frame.depth)]
    if sum(len(rows) for rows, _ in edges) < settings.min_edges:
        return None
    shifts = np.arange(-limit, limit + 1)
    score = np.zeros((len(shifts), len(shifts)))
    for (rows, columns), gradient in zip(edges, gradients, strict=True):
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


def edge_alignment(frame: RgbdFrame) -> float:
    """Mean colour gradient, 0..1, on the depth edges; NaN if there are none."""
    gradients = _color_gradients(frame.color)
    values = [gradient[edge] for edge, gradient in zip(find_depth_edges(frame.depth), gradients, strict=True)]
    on_edges = np.concatenate(values)
    return float(on_edges.mean()) if len(on_edges) else float("nan")


def _color_gradients(color: UInt8Array) -> tuple[Float32Array, Float32Array]:
    """Colour gradient along x and along y, 0..1, saturated at the 95th percentile."""
    lab = cv2.GaussianBlur(cv2.cvtColor(color, cv2.COLOR_RGB2LAB), (0, 0), 1.0).astype(np.float32)
    gradients = [np.abs(cv2.Sobel(lab, cv2.CV_32F, dx, dy, scale=1 / 8)).max(axis=2) for dx, dy in ((1, 0), (0, 1))]
    limit = max(2.0, float(np.percentile(np.maximum(*gradients), 95)))
    return tuple(np.minimum(gradient / limit, 1).astype(np.float32) for gradient in gradients)


def find_depth_edges(depth: Float32Array) -> tuple[BoolMask, BoolMask]:
    """Pixels on the near side of a depth step, without the unreliable edges of missing depth.

    Args:
        depth: (H, W) metres, 0 where missing.

    Returns:
        Two (H, W) masks: steps along x and steps along y.
    """
    out = []
    for axis in (1, 0):
        step = np.zeros(depth.shape, bool)
        for neighbour in (np.roll(depth, -1, axis), np.roll(depth, 1, axis)):
            step |= (depth > 0) & (neighbour > 0) & (neighbour - depth > 0.04 * depth + 0.01)
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
