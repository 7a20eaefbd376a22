"""Which tracks are compared: neighbours are edges, pairs further off are lifted edges, and triples go where pairs cut.

The paper builds its graph by motion (section 4): a translation that two tracks share joins them, for whatever the true
motion is, it contains this. Where translations differ, the pair's cost is left out and triples decide.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from objectflow.methods.baselines.homc.costs import CostSettings, pair_costs, triple_costs
from objectflow.methods.baselines.homc.problem import Problem
from objectflow.methods.baselines.homc.tracks import Tracks
from objectflow.typing import BoolMask, Float64Array, Int64Array

NEIGHBOURS = 12
"""Nearest tracks of a track that are its edges."""

REACHES = (4, 8, 16)
"""Lifted edges go to the nearest track of a point so many samplings away, in eight directions."""


def build_problem(tracks: Tracks, lab: Float64Array, frame: int, sampling: int, settings: CostSettings) -> Problem:
    """Tracks that are all seen in one frame -> what is to be solved.

    Args:
        tracks: N of them.
        lab: (N, 3) their colours there.
        frame: which.
        sampling: pixels between tracks.
        settings: of the costs.
    """
    at = tracks.positions[:, frame].astype(np.float64)
    if len(at) < 2:
        nothing = np.zeros((0, 2), np.int64)
        return Problem(len(at), nothing, nothing, np.zeros(0), np.zeros((0, 3), np.int64), np.zeros(0))
    tree = cKDTree(at)
    edges, lifted = _edges(at, tree), _lifted(at, tree, sampling)
    pairs = _unique(np.concatenate([edges, lifted]))
    costs = pair_costs(tracks, lab, pairs, settings)
    cut = np.flatnonzero(costs > 0)
    triples = _triples(at, tree, pairs[cut])
    triple_cost, known = triple_costs(tracks, triples, settings)
    # A pair that no triple judges keeps its own cost.
    judged = np.zeros(len(cut), np.bool_)
    judged[np.tile(np.arange(len(cut)), 2)[known & _proper(triples)]] = True
    keep = np.ones(len(pairs), np.bool_)
    keep[cut[judged]] = False
    use = known & _proper(triples)
    return Problem(
        nodes=len(at),
        edges=edges,
        pairs=pairs[keep],
        pair_costs=costs[keep],
        triples=triples[use],
        triple_costs=triple_cost[use],
    )


def _edges(at: Float64Array, tree: cKDTree) -> Int64Array:
    count = min(NEIGHBOURS + 1, len(at))
    _, near = tree.query(at, k=count)
    near = np.asarray(near, dtype=np.int64).reshape(len(at), count)
    return _unique(np.stack([np.repeat(np.arange(len(at)), count), near.ravel()], axis=1))


def _lifted(at: Float64Array, tree: cKDTree, sampling: int) -> Int64Array:
    angles = np.arange(8) * np.pi / 4
    out = []
    for reach in REACHES:
        for angle in angles:
            goal = at + reach * sampling * np.array([np.cos(angle), np.sin(angle)])
            distance, near = tree.query(goal)
            there = distance < reach * sampling / 2
            out.append(np.stack([np.flatnonzero(there), np.asarray(near)[there]], axis=1))
    return _unique(np.concatenate(out))


def _triples(at: Float64Array, tree: cKDTree, pairs: Int64Array) -> Int64Array:
    """For each pair (P, 2) the tracks nearest to the tips of the two equilateral triangles over it: (2 P, 3).

    Three points far from each other and from one line fix and test a similarity best.
    """
    p, q = at[pairs[:, 0]], at[pairs[:, 1]]
    across = (q - p)[:, ::-1] * [1, -1] * (np.sqrt(3) / 2)
    tips = np.concatenate([(p + q) / 2 + across, (p + q) / 2 - across])
    third = np.asarray(tree.query(tips)[1], dtype=np.int64) if len(tips) else np.zeros(0, np.int64)
    return np.concatenate([np.tile(pairs, (2, 1)), third[:, None]], axis=1)


def _proper(triples: Int64Array) -> BoolMask:
    """(T,) bool: three different nodes."""
    return np.asarray((triples[:, 2] != triples[:, 0]) & (triples[:, 2] != triples[:, 1]))


def _unique(pairs: Int64Array) -> Int64Array:
    pairs = np.sort(pairs[pairs[:, 0] != pairs[:, 1]], axis=1)
    return np.unique(pairs, axis=0)
