"""Point tracks: pixels tracked from frame to frame by dense optical flow while it is forward-backward consistent.

Sundaram, Brox and Keutzer (ECCV 2010). In every frame, new tracks start in cells of the sampling grid without a track,
where the image has structure. Tracks end at motion boundaries of the flow.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from objectflow.alignment import matching
from objectflow.alignment.appearance import to_gray
from objectflow.typing import BoolMask, Float32Array, IndexArray, UInt8Array

MIN_STRUCTURE = 0.125
"""Minimum smaller eigenvalue of the structure tensor, relative to its mean over the image."""

NEIGHBOUR_DISTANCE = 4
"""Distance at which a flow is compared with its surroundings, pixels."""


@dataclass(frozen=True, eq=False)
class Tracks:
    """N tracks through T frames.

    Attributes:
        positions: (N, T, 2) pixels (u, v); NaN where a track does not exist.
        deviations: (N, T - 1) variation of the flow around the track between consecutive frames, pixels.
    """

    positions: Float32Array
    deviations: Float32Array

    def visible_in(self, frame: int) -> Tracks:
        """The tracks that are visible in a frame and in at least one other."""
        visible = np.isfinite(self.positions[..., 0])
        keep = visible[:, frame] & (visible.sum(1) > 1)
        return Tracks(self.positions[keep], self.deviations[keep])


def track_points(images: Sequence[UInt8Array], sampling: int) -> Tracks:
    """Track points through (H, W, 3) RGB images, one per cell of `sampling` pixels.

    The flow of a repeated pair of images is computed once.
    """
    height, width = images[0].shape[:2]
    cache: dict[tuple[int, int], tuple[Float32Array, BoolMask, Float32Array]] = {}
    positions = np.zeros((0, len(images), 2), np.float32)
    deviations = np.zeros((0, len(images) - 1), np.float32)
    for t in range(len(images) - 1):
        key = id(images[t]), id(images[t + 1])
        if key not in cache:
            cache[key] = _flow(images[t], images[t + 1])
        flow, consistent, deviation = cache[key]
        new = _free_cells(positions[:, t], sampling, height, width)
        new = new[_has_structure(images[t])[_nearest(new, height, width)]]
        positions = np.concatenate([positions, np.full((len(new), len(images), 2), np.nan, np.float32)])
        deviations = np.concatenate([deviations, np.full((len(new), len(images) - 1), np.nan, np.float32)])
        positions[len(positions) - len(new) :, t] = new

        active = np.flatnonzero(np.isfinite(positions[:, t, 0]))
        pixels = positions[active, t]
        row, column = _nearest(pixels, height, width)
        moved = pixels + _sample(flow, pixels)
        inside = (moved >= 0).all(1) & (moved <= [width - 1, height - 1]).all(1)
        continued = inside & consistent[row, column]
        positions[active[continued], t + 1] = moved[continued]
        deviations[active[continued], t] = deviation[row, column][continued]
    return Tracks(positions, deviations)


def _flow(image: UInt8Array, next_image: UInt8Array) -> tuple[Float32Array, BoolMask, Float32Array]:
    """Flow (H, W, 2) to the next image, its consistency (H, W), and its variation on a surface (H, W), pixels."""
    flow, consistent = matching.dense_flow(to_gray(next_image), to_gray(image))
    d = NEIGHBOUR_DISTANCE
    padded = np.pad(flow, ((d, d), (d, d), (0, 0)), mode="edge")
    height, width = consistent.shape
    differences = np.stack(
        [
            np.linalg.norm(padded[i : i + height, j : j + width] - flow, axis=-1)
            for i in (0, d, 2 * d)
            for j in (0, d, 2 * d)
            if (i, j) != (d, d)
        ]
    )
    # Sundaram et al., equation 6: the flow mixes two motions at boundaries.
    du, dv = np.diff(flow, axis=1, append=flow[:, -1:]), np.diff(flow, axis=0, append=flow[-1:])
    change = np.square(du).sum(-1) + np.square(dv).sum(-1)
    consistent &= change < 0.01 * np.square(flow).sum(-1) + 0.002
    # The third smallest of the eight differences, since at the corner of a surface three neighbours lie on it.
    return flow, consistent, np.asarray(np.partition(differences, 2, axis=0)[2], dtype=np.float32)


def _has_structure(image: UInt8Array) -> BoolMask:
    """Pixels that can be localised in both directions (Brox and Malik, ECCV 2010, section 2.1)."""
    eigenvalue = cv2.cornerMinEigenVal(to_gray(image), 5)
    return np.asarray(eigenvalue > MIN_STRUCTURE * eigenvalue.mean())


def _nearest(pixels: Float32Array, height: int, width: int) -> tuple[IndexArray, IndexArray]:
    index = np.rint(pixels).astype(np.intp)
    return np.clip(index[:, 1], 0, height - 1), np.clip(index[:, 0], 0, width - 1)


def _free_cells(positions: Float32Array, sampling: int, height: int, width: int) -> Float32Array:
    """Centres (M, 2) of the cells without a track."""
    rows, columns = -(-height // sampling), -(-width // sampling)
    occupied = np.zeros((rows, columns), np.bool_)
    cell = (positions[np.isfinite(positions[:, 0])] / sampling).astype(int)
    occupied[np.clip(cell[:, 1], 0, rows - 1), np.clip(cell[:, 0], 0, columns - 1)] = True
    row, column = np.nonzero(~occupied)
    centers = np.stack([column, row], axis=1) * sampling + (sampling - 1) / 2
    return np.asarray(np.minimum(centers, [width - 1, height - 1]), dtype=np.float32)


def _sample(flow: Float32Array, pixels: Float32Array) -> Float32Array:
    u, v = (np.ascontiguousarray(pixels[:, k, None]) for k in (0, 1))
    if not len(pixels):
        return np.zeros((0, 2), np.float32)
    # `cv2.remap` is limited to 32767 rows.
    parts = [
        cv2.remap(flow, u[k : k + 30000], v[k : k + 30000], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        for k in range(0, len(pixels), 30000)
    ]
    return np.asarray(np.concatenate(parts)[:, 0], dtype=np.float32)
