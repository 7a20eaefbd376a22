"""Point trajectories: pixels followed from frame to frame by dense optical flow, as long as it goes there and back.

Sundaram, Brox and Keutzer (ECCV 2010). A new track starts wherever a cell of the sampling grid has none, in every
frame, so that what comes into sight is followed as well; but only where the image has structure, and none goes on
where the flow changes from the motion of one surface to that of another.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from objectflow.alignment import matching
from objectflow.typing import BoolMask, Float32Array, IndexArray, UInt8Array

STRUCTURE = 0.125
"""Least second eigenvalue of the structure tensor, in units of its mean over the image."""

SPREAD = 4
"""Pixels: how far off a flow is compared with its surroundings."""


@dataclass(frozen=True, eq=False)
class Tracks:
    """N tracks through T frames.

    Attributes:
        positions: (N, T, 2) pixels as (u, v); NaN where a track is not.
        deviations: (N, T - 1) pixels: how much the flow varies around the track, from each frame to the next.
    """

    positions: Float32Array
    deviations: Float32Array

    def seen_in(self, frame: int) -> Tracks:
        """Those that are seen in a frame and in another."""
        there = np.isfinite(self.positions[..., 0])
        keep = there[:, frame] & (there.sum(1) > 1)
        return Tracks(self.positions[keep], self.deviations[keep])


def follow(images: Sequence[UInt8Array], sampling: int) -> Tracks:
    """Follow points through (H, W, 3) RGB images, one for each cell of `sampling` pixels.

    A pair of images that comes again is not computed again.
    """
    height, width = images[0].shape[:2]
    steps: dict[tuple[int, int], tuple[Float32Array, BoolMask, Float32Array]] = {}
    positions = np.zeros((0, len(images), 2), np.float32)
    deviations = np.zeros((0, len(images) - 1), np.float32)
    for t in range(len(images) - 1):
        key = id(images[t]), id(images[t + 1])
        if key not in steps:
            steps[key] = _flow(images[t], images[t + 1])
        flow, consistent, deviation = steps[key]
        fresh = _free_cells(positions[:, t], sampling, height, width)
        fresh = fresh[_structure(images[t])[_nearest(fresh, height, width)]]
        positions = np.concatenate([positions, np.full((len(fresh), len(images), 2), np.nan, np.float32)])
        deviations = np.concatenate([deviations, np.full((len(fresh), len(images) - 1), np.nan, np.float32)])
        positions[len(positions) - len(fresh) :, t] = fresh

        here = np.flatnonzero(np.isfinite(positions[:, t, 0]))
        at = positions[here, t]
        row, column = _nearest(at, height, width)
        arrived = at + _sample(flow, at)
        inside = (arrived >= 0).all(1) & (arrived <= [width - 1, height - 1]).all(1)
        goes_on = inside & consistent[row, column]
        positions[here[goes_on], t + 1] = arrived[goes_on]
        deviations[here[goes_on], t] = deviation[row, column][goes_on]
    return Tracks(positions, deviations)


def _flow(image: UInt8Array, following: UInt8Array) -> tuple[Float32Array, BoolMask, Float32Array]:
    """Flow (H, W, 2) to the following image, where it comes back, and (H, W) how much it varies on one surface."""
    flow, consistent = matching.dense_flow(matching.gray(following), matching.gray(image))
    padded = np.pad(flow, ((SPREAD, SPREAD), (SPREAD, SPREAD), (0, 0)), mode="edge")
    height, width = consistent.shape
    differences = np.stack(
        [
            np.linalg.norm(padded[i : i + height, j : j + width] - flow, axis=-1)
            for i in (0, SPREAD, 2 * SPREAD)
            for j in (0, SPREAD, 2 * SPREAD)
            if (i, j) != (SPREAD, SPREAD)
        ]
    )
    # The third smallest of eight: at the corner of a surface three neighbours still lie on it.
    du, dv = np.diff(flow, axis=1, append=flow[:, -1:]), np.diff(flow, axis=0, append=flow[-1:])
    change = np.square(du).sum(-1) + np.square(dv).sum(-1)
    # Sundaram et al., equation 6: there the flow is a mixture of two motions.
    consistent &= change < 0.01 * np.square(flow).sum(-1) + 0.002
    return flow, consistent, np.asarray(np.partition(differences, 2, axis=0)[2], dtype=np.float32)


def _structure(image: UInt8Array) -> BoolMask:
    """Where a point can be told from its surroundings in every direction (Brox and Malik, ECCV 2010, section 2.1)."""
    least = cv2.cornerMinEigenVal(matching.gray(image), 5)
    return np.asarray(least > STRUCTURE * least.mean())


def _nearest(at: Float32Array, height: int, width: int) -> tuple[IndexArray, IndexArray]:
    pixel = np.rint(at).astype(np.intp)
    return np.clip(pixel[:, 1], 0, height - 1), np.clip(pixel[:, 0], 0, width - 1)


def _free_cells(positions: Float32Array, sampling: int, height: int, width: int) -> Float32Array:
    """Centres (M, 2) of the cells without a track."""
    rows, columns = -(-height // sampling), -(-width // sampling)
    taken = np.zeros((rows, columns), np.bool_)
    at = positions[np.isfinite(positions[:, 0])]
    cell = (at / sampling).astype(int)
    taken[np.clip(cell[:, 1], 0, rows - 1), np.clip(cell[:, 0], 0, columns - 1)] = True
    row, column = np.nonzero(~taken)
    centers = np.stack([column, row], axis=1) * sampling + (sampling - 1) / 2
    return np.asarray(np.minimum(centers, [width - 1, height - 1]), dtype=np.float32)


def _sample(flow: Float32Array, at: Float32Array) -> Float32Array:
    u, v = (np.ascontiguousarray(at[:, k, None]) for k in (0, 1))
    if not len(at):
        return np.zeros((0, 2), np.float32)
    # OpenCV's images are limited to 32767 rows.
    parts = [
        cv2.remap(flow, u[k : k + 30000], v[k : k + 30000], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        for k in range(0, len(at), 30000)
    ]
    return np.asarray(np.concatenate(parts)[:, 0], dtype=np.float32)
