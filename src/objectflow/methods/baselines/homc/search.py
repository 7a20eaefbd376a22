"""The third-order part of the solver: local search on the true energy, by joining parts and moving single nodes.

The paper computes the gains of Kernighan-Lin with the higher-order terms. Here a library's Kernighan-Lin runs on
triple costs spread over pairs (`multicut`), followed by this search, whose every step lowers the true energy.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from objectflow.methods.baselines.homc.multicut import solve_pairs, spread_triples
from objectflow.methods.baselines.homc.problem import Problem
from objectflow.typing import Float64Array, Int64Array

ROUNDS = 8
"""Maximum number of rounds of Kernighan-Lin and search; three are typical."""

SHARES = (1 / 3, 0.0, 0.5, 1.0)
"""Shares of a triple's cost per pair, one for each initial partition."""

_MIN_GAIN = 1e-9
"""Smallest decrease of the energy that counts as an improvement."""


def solve(problem: Problem) -> Int64Array:
    """Compute a partition (N,) of low energy, numbered from 0; deterministic.

    Raises:
        MissingExtraError: `bioimage-cpp` is not installed.
    """
    if problem.nodes == 0 or len(problem.edges) == 0:
        return np.arange(problem.nodes)
    search = LocalSearch(problem)
    starts = [solve_pairs(problem, *spread_triples(problem, None, share), start=None) for share in SHARES]
    improved = [search.improve(problem.connected(labels)) for labels in starts]
    best = min(improved, key=problem.energy)
    for _ in range(ROUNDS):
        labels = solve_pairs(problem, *spread_triples(problem, best), start=best)
        labels = search.improve(problem.connected(labels))
        if problem.energy(labels) >= problem.energy(best) - _MIN_GAIN:
            break
        best = labels
    return best


class LocalSearch:
    """Local search; holds the neighbours and costs of every node in arrays."""

    def __init__(self, problem: Problem) -> None:
        self.problem = problem
        n = problem.nodes
        self.edge_starts, (self.edge_other,) = _by_node(n, problem.edges, (1, 0))
        self.pair_starts, (self.pair_other, self.pair_cost) = _by_node(n, problem.pairs, (1, 0), problem.pair_costs)
        firsts = np.concatenate([problem.triples[:, k] for k in range(3)])
        others = np.concatenate([problem.triples[:, [(k + 1) % 3, (k + 2) % 3]] for k in range(3)])
        order = np.argsort(firsts, kind="stable")
        self.triple_starts = np.searchsorted(firsts[order], np.arange(n + 1))
        self.triple_others, self.triple_cost = others[order], np.tile(problem.triple_costs, 3)[order]

    def improve(self, labels: Int64Array) -> Int64Array:
        """Join parts and move nodes until neither lowers the energy."""
        labels = labels.copy()
        while True:
            joined = self._join(labels)
            if not self._move(labels) and not joined:
                return self.problem.connected(labels)

    def _join(self, labels: Int64Array) -> bool:
        """Join two neighbouring parts, or three at once, while this lowers the energy."""
        changed = False
        while True:
            _, part = np.unique(labels, return_inverse=True)
            count = int(part.max()) + 1
            groups, costs = self._join_costs(part, count)
            joined = np.zeros(count, np.bool_)
            for k in np.argsort(costs, kind="stable"):
                if costs[k] >= -_MIN_GAIN:
                    break
                # Joins without a common part are independent, so all of them are made.
                if not joined[groups[k]].any():
                    joined[groups[k]] = True
                    labels[np.isin(part, groups[k])] = labels[np.flatnonzero(part == groups[k][0])[0]]
            if not joined.any():
                return changed
            changed = True

    def _join_costs(self, part: Int64Array, count: int) -> tuple[Int64Array, Float64Array]:
        """Costs of joining neighbouring parts: (M, 3) parts, the last two equal for a pair, and (M,) costs."""
        p = self.problem
        pair = np.sort(part[p.pairs], axis=1)
        cut = pair[:, 0] != pair[:, 1]
        triple = np.sort(part[p.triples], axis=1)
        new = np.stack([triple[:, 0] != triple[:, 1], triple[:, 1] != triple[:, 2]])
        spans_two = new.sum(0) == 1
        two_parts = np.concatenate([pair[cut], triple[spans_two][:, [0, 2]]])
        keys, two_costs = _sum_by_key(
            two_parts[:, 0] * count + two_parts[:, 1], np.concatenate([p.pair_costs[cut], p.triple_costs[spans_two]])
        )
        edge = np.sort(part[p.edges], axis=1)
        adjacent_keys = np.unique(edge[:, 0] * count + edge[:, 1])
        adjacent = np.isin(keys, adjacent_keys)
        # Joining three parts at once may lower the energy where joining any two of them does not.
        three = triple[new.all(0)]
        triple_keys, three_costs = _sum_by_key(
            (three[:, 0] * count + three[:, 1]) * count + three[:, 2], p.triple_costs[new.all(0)]
        )
        three = np.stack([triple_keys // count**2, triple_keys // count % count, triple_keys % count], axis=1)
        sides = [three[:, i] * count + three[:, j] for i, j in ((0, 1), (1, 2), (0, 2))]
        connected = sum(np.isin(side, adjacent_keys).astype(int) for side in sides) >= 2
        for side in sides:
            three_costs = three_costs + _lookup(keys, two_costs, side)
        groups = np.stack([keys // count, keys % count, keys % count], axis=1)[adjacent]
        return np.concatenate([groups, three[connected]]), np.concatenate(
            [two_costs[adjacent], three_costs[connected]]
        )

    def _move(self, labels: Int64Array) -> bool:
        """Move single nodes to a neighbouring part or to a new part."""
        changed = False
        queue = np.arange(self.problem.nodes)
        while len(queue):
            affected: list[Int64Array] = []
            for node in queue:
                target = self._better_part(int(node), labels)
                if target is not None:
                    labels[node] = target
                    affected.append(self._related(int(node)))
                    changed = True
            queue = np.unique(np.concatenate(affected)) if affected else np.zeros(0, np.int64)
        return changed

    def _better_part(self, node: int, labels: Int64Array) -> int | None:
        neighbours = self.edge_other[self.edge_starts[node] : self.edge_starts[node + 1]]
        pairs = slice(self.pair_starts[node], self.pair_starts[node + 1])
        triples = slice(self.triple_starts[node], self.triple_starts[node + 1])
        pair_parts, pair_costs = labels[self.pair_other[pairs]], self.pair_cost[pairs]
        triple_parts, triple_costs = labels[self.triple_others[triples]], self.triple_cost[triples]
        joined = triple_parts[:, 0] == triple_parts[:, 1]
        parts = np.concatenate([pair_parts, triple_parts[joined, 0]])
        costs = np.concatenate([pair_costs, triple_costs[joined]])
        current = int(labels[node])
        current_cost = float(costs[parts == current].sum())
        best, target = min(0.0, current_cost) - _MIN_GAIN, None
        if current_cost > _MIN_GAIN:
            best, target = -_MIN_GAIN, int(labels.max()) + 1
        for part in np.unique(labels[neighbours]):
            cost = float(costs[parts == part].sum())
            if part != current and cost < best:
                best, target = cost, int(part)
        if target is None or not self._stays_connected(node, labels, neighbours):
            return None
        return target

    def _stays_connected(self, node: int, labels: Int64Array, neighbours: Int64Array) -> bool:
        """Whether the node's part remains connected without the node."""
        part = labels[node]
        unreached = {int(n) for n in neighbours[labels[neighbours] == part]}
        if len(unreached) <= 1:
            return True
        start = unreached.pop()
        visited, stack = {node, start}, [start]
        while stack and unreached:
            current = stack.pop()
            around = self.edge_other[self.edge_starts[current] : self.edge_starts[current + 1]]
            for neighbour in around[labels[around] == part].tolist():
                if neighbour not in visited:
                    visited.add(neighbour)
                    unreached.discard(neighbour)
                    stack.append(neighbour)
        return not unreached

    def _related(self, node: int) -> Int64Array:
        """Nodes that share an edge, a pair or a triple with a node."""
        return np.concatenate(
            [
                self.edge_other[self.edge_starts[node] : self.edge_starts[node + 1]],
                self.pair_other[self.pair_starts[node] : self.pair_starts[node + 1]],
                self.triple_others[self.triple_starts[node] : self.triple_starts[node + 1]].ravel(),
            ]
        )


def _sum_by_key(keys: Int64Array, values: Float64Array) -> tuple[Int64Array, Float64Array]:
    """Unique keys in ascending order, and the sum of each key's values."""
    unique, index = np.unique(keys, return_inverse=True)
    return unique, np.asarray(np.bincount(index, weights=values, minlength=len(unique)), dtype=np.float64)


def _lookup(keys: Int64Array, values: Float64Array, wanted: Int64Array) -> Float64Array:
    """Values of the wanted keys, 0 for missing keys; `keys` must be sorted."""
    if not len(keys):
        return np.zeros(len(wanted))
    index = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
    return np.where(keys[index] == wanted, values[index], 0.0)


def _by_node(
    count: int, pairs: Int64Array, swap: tuple[int, int], *values: Float64Array
) -> tuple[Int64Array, tuple[NDArray[Any], ...]]:
    """Both directions of pairs (P, 2), by their first node: (N + 1,) starts, the other node, and the values."""
    both = np.concatenate([pairs, pairs[:, swap]])
    order = np.argsort(both[:, 0], kind="stable")
    starts = np.searchsorted(both[order, 0], np.arange(count + 1))
    return starts, (both[order, 1], *(np.tile(value, 2)[order] for value in values))
