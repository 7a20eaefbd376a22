"""Graph of the multicut problem: edges between neighbours, lifted edges between distant tracks, and triples.

As in section 4 of the paper, a pair with a common translation is joined by its pair cost, since every motion model
contains translations. A pair with a cutting cost is replaced by triples, which also admit rotation and scaling.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from objectflow.methods.baselines.homc.costs import CostSettings, pair_costs, triple_costs
from objectflow.methods.baselines.homc.problem import Problem
from objectflow.methods.baselines.homc.tracks import Tracks
from objectflow.typing import BoolMask, Float64Array, Int64Array

NEIGHBOURS = 12
"""Number of nearest tracks to which a track has edges."""

LIFTED_DISTANCES = (4, 8, 16)
"""Lengths of lifted edges in units of the sampling; each has eight directions and ends at the nearest track."""


def build_problem(tracks: Tracks, lab: Float64Array, frame: int, sampling: int, settings: CostSettings) -> Problem:
    """Build the multicut problem of tracks that are all visible in one frame.

    Args:
        tracks: N tracks.
        lab: (N, 3) their colours in that frame.
        frame: its index.
        sampling: spacing of the tracks, pixels.
        settings: of the costs.
    """
    positions = tracks.positions[:, frame].astype(np.float64)
    if len(positions) < 2:
        empty = np.zeros((0, 2), np.int64)
        return Problem(len(positions), empty, empty, np.zeros(0), np.zeros((0, 3), np.int64), np.zeros(0))
    tree = cKDTree(positions)
    edges, lifted = _neighbour_edges(positions, tree), _lifted_edges(positions, tree, sampling)
    pairs = _unique(np.concatenate([edges, lifted]))
    costs = pair_costs(tracks, lab, pairs, settings)
    cut = np.flatnonzero(costs > 0)
    triples = propose_triples(positions, tree, pairs[cut])
    triple_cost, known = triple_costs(tracks, triples, settings)
    use = known & _has_distinct_nodes(triples)
    # A pair without a usable triple keeps its own cost.
    replaced = np.zeros(len(cut), np.bool_)
    replaced[np.tile(np.arange(len(cut)), 2)[use]] = True
    keep = np.ones(len(pairs), np.bool_)
    keep[cut[replaced]] = False
    return Problem(
        nodes=len(positions),
        edges=edges,
        pairs=pairs[keep],
        pair_costs=costs[keep],
        triples=triples[use],
        triple_costs=triple_cost[use],
    )


def propose_triples(positions: Float64Array, tree: cKDTree, pairs: Int64Array) -> Int64Array:
    """Complete each pair (P, 2) to two triples (2 P, 3) by the tracks nearest to the tips of equilateral triangles.

    Distant points that are not collinear determine and test a similarity best.
    """
    p, q = positions[pairs[:, 0]], positions[pairs[:, 1]]
    across = (q - p)[:, ::-1] * [1, -1] * (np.sqrt(3) / 2)
    tips = np.concatenate([(p + q) / 2 + across, (p + q) / 2 - across])
    third = np.asarray(tree.query(tips)[1], dtype=np.int64) if len(tips) else np.zeros(0, np.int64)
    return np.concatenate([np.tile(pairs, (2, 1)), third[:, None]], axis=1)


def _neighbour_edges(positions: Float64Array, tree: cKDTree) -> Int64Array:
    count = min(NEIGHBOURS + 1, len(positions))
    _, nearest = tree.query(positions, k=count)
    nearest = np.asarray(nearest, dtype=np.int64).reshape(len(positions), count)
    return _unique(np.stack([np.repeat(np.arange(len(positions)), count), nearest.ravel()], axis=1))


def _lifted_edges(positions: Float64Array, tree: cKDTree, sampling: int) -> Int64Array:
    angles = np.arange(8) * np.pi / 4
    out = []
    for length in LIFTED_DISTANCES:
        for angle in angles:
            target = positions + length * sampling * np.array([np.cos(angle), np.sin(angle)])
            distance, nearest = tree.query(target)
            found = distance < length * sampling / 2
            out.append(np.stack([np.flatnonzero(found), np.asarray(nearest)[found]], axis=1))
    return _unique(np.concatenate(out))


def _has_distinct_nodes(triples: Int64Array) -> BoolMask:
    """(T,) bool: whether the three nodes differ."""
    return np.asarray((triples[:, 2] != triples[:, 0]) & (triples[:, 2] != triples[:, 1]))


def _unique(pairs: Int64Array) -> Int64Array:
    pairs = np.sort(pairs[pairs[:, 0] != pairs[:, 1]], axis=1)
    return np.unique(pairs, axis=0)
