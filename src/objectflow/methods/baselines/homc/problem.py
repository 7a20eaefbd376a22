"""The higher-order lifted multicut problem: a minimum-cost partition of a graph's nodes.

    min over partitions of   sum over pairs of c_pq [p, q joined] + sum over triples of c_pqr [p, q, r joined]

subject to each part being connected by the graph's edges (section 3 of the paper). Costs apply to joined nodes; the
paper's apply to cut nodes, which differs by a constant. Pairs that are not edges are lifted edges.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from objectflow.typing import Float64Array, Int64Array


@dataclass(frozen=True, eq=False)
class Problem:
    """A graph with costs of pairs and triples.

    Attributes:
        nodes: number of nodes.
        edges: (E, 2) edges, by which parts must be connected.
        pairs, pair_costs: (P, 2) unique pairs, edges or not, and (P,) costs; negative costs join.
        triples, triple_costs: (T, 3) triples of distinct nodes, and (T,) costs.
    """

    nodes: int
    edges: Int64Array
    pairs: Int64Array
    pair_costs: Float64Array
    triples: Int64Array
    triple_costs: Float64Array

    def energy(self, labels: Int64Array) -> float:
        """Cost of a partition (N,)."""
        pair = labels[self.pairs]
        triple = labels[self.triples]
        joined = (triple[:, 0] == triple[:, 1]) & (triple[:, 1] == triple[:, 2])
        return float(self.pair_costs[pair[:, 0] == pair[:, 1]].sum() + self.triple_costs[joined].sum())

    def connected(self, labels: Int64Array) -> Int64Array:
        """Split the parts of a partition (N,) into connected components, numbered from 0."""
        inside = self.edges[labels[self.edges[:, 0]] == labels[self.edges[:, 1]]]
        graph = coo_array((np.ones(len(inside)), (inside[:, 0], inside[:, 1])), shape=(self.nodes, self.nodes))
        return np.asarray(connected_components(graph, directed=False)[1], dtype=np.int64)

    def is_feasible(self, labels: Int64Array) -> bool:
        """Whether every part is connected."""
        return len(np.unique(self.connected(labels))) == len(np.unique(labels))
