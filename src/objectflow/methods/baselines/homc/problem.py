"""The higher-order lifted multicut problem: a partition of a graph's nodes that pays for what it keeps together.

    min over partitions of   sum over pairs of c_pq [p, q together] + sum over triples of c_pqr [p, q, r together]

subject to each part being connected by the graph's edges (section 3 of the paper, with costs paid for being together
where the paper pays for being cut: the two differ by a constant). Pairs that are no edges are the lifted ones.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from objectflow.typing import Float64Array, Int64Array


@dataclass(frozen=True, eq=False)
class Problem:
    """Nodes 0 .. `nodes` - 1.

    Attributes:
        nodes: how many.
        edges: (E, 2) the graph: what may hold a part together.
        pairs, pair_costs: (P, 2) and (P,): edges or not, each pair once; negative joins.
        triples, triple_costs: (T, 3) and (T,): three different nodes each.
    """

    nodes: int
    edges: Int64Array
    pairs: Int64Array
    pair_costs: Float64Array
    triples: Int64Array
    triple_costs: Float64Array

    def energy(self, labels: Int64Array) -> float:
        """What a partition (N,) costs."""
        pair = labels[self.pairs]
        triple = labels[self.triples]
        whole = (triple[:, 0] == triple[:, 1]) & (triple[:, 1] == triple[:, 2])
        return float(self.pair_costs[pair[:, 0] == pair[:, 1]].sum() + self.triple_costs[whole].sum())

    def connected(self, labels: Int64Array) -> Int64Array:
        """Labels (N,) with parts that the graph does not connect taken apart; numbered from 0."""
        inside = self.edges[labels[self.edges[:, 0]] == labels[self.edges[:, 1]]]
        graph = coo_array((np.ones(len(inside)), (inside[:, 0], inside[:, 1])), shape=(self.nodes, self.nodes))
        return np.asarray(connected_components(graph, directed=False)[1], dtype=np.int64)

    def is_feasible(self, labels: Int64Array) -> bool:
        """Whether every part is connected."""
        return len(np.unique(self.connected(labels))) == len(np.unique(labels))
