"""Costs of keeping two or three tracks in one segment; negative costs join (section 4 of the paper).

The cost of a pair depends on motion, distance and colour, with the constants of the paper's translational model:

    c_pq = -max(6 - 2 d_m - 4 d_s - 0.02 d_c,  t0 - 2 d_m)

Different motions of a pair may be due to a rotation or scaling, which three tracks can distinguish: two of them
determine a 2D similarity transform, and d is the third track's deviation from it in units of the flow's deviation:

    c = -1 + 0.8 d

This cost is computed with each track as the third. The minimum of the three is used if their maximum is positive, and
the maximum otherwise.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from objectflow.methods.baselines.homc.tracks import Tracks
from objectflow.typing import BoolMask, Float64Array, Int64Array

_CHUNK = 1 << 16
"""Number of pairs or triples per chunk, whose positions in all frames take a few megabytes."""


@dataclass(frozen=True)
class CostSettings:
    """Constants of the costs.

    Attributes:
        near: t0' = 6, bias towards joining two tracks at the same position.
        join: t0, bias towards joining any two tracks.
        motion, distance, color: weights of the three differences.
        distance_unit: unit of d_s, pixels.
        noise: tracking noise, added to the flow's deviation, pixels.
        offset, slope: of the cost of a triple, -1 and 0.8.
    """

    near: float = 6.0
    join: float = 2.0
    motion: float = 2.0
    distance: float = 4.0
    color: float = 0.02
    distance_unit: float = 32.0
    noise: float = 0.5
    offset: float = -1.0
    slope: float = 0.8


def pair_costs(tracks: Tracks, lab: Float64Array, pairs: Int64Array, settings: CostSettings) -> Float64Array:
    """Costs of pairs of tracks.

    Args:
        tracks: N tracks.
        lab: (N, 3) their colours in Lab, L in 0..100.
        pairs: (P, 2) indices of tracks.
        settings: the constants.

    Returns:
        (P,) costs; 0 for tracks that have no two consecutive frames in common.
    """
    out = np.zeros(len(pairs))
    for start in range(0, len(pairs), _CHUNK):
        p, q = pairs[start : start + _CHUNK].T
        a, b = tracks.positions[p], tracks.positions[q]
        difference = np.linalg.norm(np.diff(a, axis=1) - np.diff(b, axis=1), axis=-1)
        deviation = np.fmin(tracks.deviations[p], tracks.deviations[q]) + settings.noise
        d_m, common = _maximum(difference / deviation)
        d_s = _mean(np.linalg.norm(a - b, axis=-1)) / settings.distance_unit
        d_c = np.linalg.norm(lab[p] - lab[q], axis=-1)
        near = settings.near - settings.motion * d_m - settings.distance * d_s - settings.color * d_c
        out[start : start + _CHUNK] = np.where(common, -np.maximum(near, settings.join - settings.motion * d_m), 0)
    return out


def triple_costs(tracks: Tracks, triples: Int64Array, settings: CostSettings) -> tuple[Float64Array, BoolMask]:
    """Costs of triples of tracks.

    Args:
        tracks: N tracks.
        triples: (T, 3) indices of tracks.
        settings: the constants.

    Returns:
        (T,) costs, and (T,) bool: whether the three have distinct positions in two consecutive frames.
    """
    costs, known = np.zeros(len(triples)), np.zeros(len(triples), np.bool_)
    z = tracks.positions[..., 0].astype(np.complex128) + 1j * tracks.positions[..., 1]
    for start in range(0, len(triples), _CHUNK):
        chunk = triples[start : start + _CHUNK]
        deviation = tracks.deviations[chunk].min(1) + settings.noise
        errors = []
        for k in range(3):
            a, b, c = (z[chunk[:, (k + shift) % 3]] for shift in (1, 2, 0))
            with np.errstate(invalid="ignore", divide="ignore"):
                similarity = np.diff(b - a, axis=1) / (b - a)[:, :-1]
                # Motion of c under the similarity of a and b, minus its observed motion.
                residual = np.diff(a, axis=1) + similarity * (c - a)[:, :-1] - np.diff(c, axis=1)
            error = np.abs(residual) / deviation
            error[~np.isfinite(error)] = np.nan
            errors.append(_maximum(error))
        d = np.stack([error[0] for error in errors])
        cost = settings.offset + settings.slope * d
        minimum, maximum = cost.min(0), cost.max(0)
        costs[start : start + _CHUNK] = np.where(maximum > 0, minimum, maximum)
        known[start : start + _CHUNK] = np.logical_and.reduce([error[1] for error in errors])
    costs[~known] = 0
    return costs, known


def _maximum(values: Float64Array) -> tuple[Float64Array, BoolMask]:
    """(M, T) with NaN -> (M,) maxima, 0 where all values are NaN, and (M,) bool: whether there is a value."""
    known = ~np.isnan(values)
    return np.asarray(np.where(known, values, 0).max(1, initial=0)), np.asarray(known.any(1))


def _mean(values: Float64Array) -> Float64Array:
    known = ~np.isnan(values)
    return np.asarray(np.where(known, values, 0).sum(1) / np.maximum(known.sum(1), 1), dtype=np.float64)
