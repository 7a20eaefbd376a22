"""What it costs to keep two or three tracks in one segment; negative joins (section 4 of the paper).

Pairs, by motion, distance and colour, with the constants of the paper's translational model:

    c_pq = -max(6 - 2 d_m - 4 d_s - 0.02 d_c,  t0 - 2 d_m)

Where a pair's motions differ, the difference may be a rotation or a change of size. Three tracks can tell: two of them
fix a similarity of the plane, the third one obeys it or does not, d pixels off in units of the flow's deviation:

    c = -1 + 0.8 d,    of the three roles: the least where the greatest is above 0, otherwise the greatest
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from objectflow.methods.baselines.homc.tracks import Tracks
from objectflow.typing import BoolMask, Float64Array, Int64Array

_CHUNK = 1 << 16
"""Pairs or triples at a time: their positions in all frames are a few megabytes."""


@dataclass(frozen=True)
class CostSettings:
    """The constants above.

    Attributes:
        near: t0' = 6, what speaks for joining two tracks at one place.
        join: t0, what speaks for joining any two.
        motion, distance, color: weights of the three differences.
        distance_unit: pixels that count as 1 of d_s.
        noise: pixels, the least deviation: how well a point is followed where the flow is even.
        offset, slope: of a triple, -1 and 0.8.
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
    """(P, 2) tracks -> (P,) costs; 0 where the two are never seen to move together.

    Args:
        tracks: all.
        lab: (N, 3) their colours in Lab, L in 0..100.
        pairs: which.
        settings: the constants.
    """
    out = np.zeros(len(pairs))
    for at in range(0, len(pairs), _CHUNK):
        p, q = pairs[at : at + _CHUNK].T
        a, b = tracks.positions[p], tracks.positions[q]
        difference = np.linalg.norm(np.diff(a, axis=1) - np.diff(b, axis=1), axis=-1)
        deviation = np.fmin(tracks.deviations[p], tracks.deviations[q]) + settings.noise
        d_m, common = _greatest(difference / deviation)
        d_s = _mean(np.linalg.norm(a - b, axis=-1)) / settings.distance_unit
        d_c = np.linalg.norm(lab[p] - lab[q], axis=-1)
        near = settings.near - settings.motion * d_m - settings.distance * d_s - settings.color * d_c
        out[at : at + _CHUNK] = np.where(common, -np.maximum(near, settings.join - settings.motion * d_m), 0)
    return out


def triple_costs(tracks: Tracks, triples: Int64Array, settings: CostSettings) -> tuple[Float64Array, BoolMask]:
    """(T, 3) tracks -> (T,) costs, and (T,) bool: the three are seen to move together, and lie apart."""
    costs, known = np.zeros(len(triples)), np.zeros(len(triples), np.bool_)
    z = tracks.positions[..., 0].astype(np.complex128) + 1j * tracks.positions[..., 1]
    for at in range(0, len(triples), _CHUNK):
        three = triples[at : at + _CHUNK]
        deviation = tracks.deviations[three].min(1) + settings.noise
        roles = []
        for k in range(3):
            a, b, c = (z[three[:, (k + shift) % 3]] for shift in (1, 2, 0))
            with np.errstate(invalid="ignore", divide="ignore"):
                turn = np.diff(b - a, axis=1) / (b - a)[:, :-1]
                # How the similarity of a and b moves c, less how c moves.
                off = np.diff(a, axis=1) + turn * (c - a)[:, :-1] - np.diff(c, axis=1)
            error = np.abs(off) / deviation
            error[~np.isfinite(error)] = np.nan
            roles.append(_greatest(error))
        d = np.stack([role[0] for role in roles])
        cost = settings.offset + settings.slope * d
        least, greatest = cost.min(0), cost.max(0)
        costs[at : at + _CHUNK] = np.where(greatest > 0, least, greatest)
        known[at : at + _CHUNK] = np.logical_and.reduce([role[1] for role in roles])
    costs[~known] = 0
    return costs, known


def _greatest(values: Float64Array) -> tuple[Float64Array, BoolMask]:
    """(M, T) with NaN -> (M,) greatest, and (M,) bool: there is one; 0 where there is none."""
    known = ~np.isnan(values)
    return np.asarray(np.where(known, values, 0).max(1, initial=0)), np.asarray(known.any(1))


def _mean(values: Float64Array) -> Float64Array:
    known = ~np.isnan(values)
    return np.asarray(np.where(known, values, 0).sum(1) / np.maximum(known.sum(1), 1), dtype=np.float64)
