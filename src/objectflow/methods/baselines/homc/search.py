"""The third-order part of the solver: a local search on the true energy, by joining parts and moving single nodes.

The paper lets Kernighan-Lin compute its gains with the higher-order terms. Here Kernighan-Lin stays that of a library,
runs on triples spread over pairs (`multicut`), and this search follows: what it changes always lowers the true energy.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from objectflow.methods.baselines.homc.multicut import solve_pairs, spread_triples
from objectflow.methods.baselines.homc.problem import Problem
from objectflow.typing import Float64Array, Int64Array

ROUNDS = 8
"""Most rounds of Kernighan-Lin and search; three are usual."""

SHARES = (1 / 3, 0.0, 0.5, 1.0)
"""How much of a triple's costs each of its pairs has in the partitions to start from: the first step towards joining
three nodes is worth nothing yet, or all of it."""

_GAIN = 1e-9


def solve(problem: Problem) -> Int64Array:
    """A partition (N,) of low energy, numbered from 0; the same for the same problem.

    Raises:
        MissingExtraError: `bioimage-cpp` is not installed.
    """
    if problem.nodes == 0 or len(problem.edges) == 0:
        return np.arange(problem.nodes)
    search = _Search(problem)
    starts = [solve_pairs(problem, *spread_triples(problem, None, share), start=None) for share in SHARES]
    found = [search.improve(problem.connected(labels)) for labels in starts]
    best = min(found, key=problem.energy)
    for _ in range(ROUNDS):
        labels = solve_pairs(problem, *spread_triples(problem, best), start=best)
        labels = search.improve(problem.connected(labels))
        if problem.energy(labels) >= problem.energy(best) - _GAIN:
            break
        best = labels
    return best


class _Search:
    """Neighbours of every node, in arrays."""

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
        """Join and move until neither lowers the energy."""
        labels = labels.copy()
        while True:
            joined = self._join(labels)
            if not self._move(labels) and not joined:
                return self.problem.connected(labels)

    def _join(self, labels: Int64Array) -> bool:
        """Join two neighbouring parts, or three at once, as long as that gains."""
        changed = False
        while True:
            _, part = np.unique(labels, return_inverse=True)
            count = int(part.max()) + 1
            groups, gains = self._joins(part, count)
            taken = np.zeros(count, np.bool_)
            for k in np.argsort(gains, kind="stable"):
                if gains[k] >= -_GAIN:
                    break
                # Joins that share no part do not change each other's gains: all are made.
                if not taken[groups[k]].any():
                    taken[groups[k]] = True
                    labels[np.isin(part, groups[k])] = labels[np.flatnonzero(part == groups[k][0])[0]]
            if not taken.any():
                return changed
            changed = True

    def _joins(self, part: Int64Array, count: int) -> tuple[Int64Array, Float64Array]:
        """What joining neighbouring parts costs: (M, 3) parts, the last two equal for a pair, and (M,)."""
        p = self.problem
        pair = np.sort(part[p.pairs], axis=1)
        apart = pair[:, 0] != pair[:, 1]
        triple = np.sort(part[p.triples], axis=1)
        new = np.stack([triple[:, 0] != triple[:, 1], triple[:, 1] != triple[:, 2]])
        spans_two = new.sum(0) == 1
        two = np.concatenate([pair[apart], triple[spans_two][:, [0, 2]]])
        keys, of_two = _sums(
            two[:, 0] * count + two[:, 1], np.concatenate([p.pair_costs[apart], p.triple_costs[spans_two]])
        )
        edge = np.sort(part[p.edges], axis=1)
        touching = np.unique(edge[:, 0] * count + edge[:, 1])
        near = np.isin(keys, touching)
        # Three parts none of which gains by joining one other: their triples may be worth all three joins.
        three = triple[new.all(0)]
        triple_keys, of_three = _sums(
            (three[:, 0] * count + three[:, 1]) * count + three[:, 2], p.triple_costs[new.all(0)]
        )
        three = np.stack([triple_keys // count**2, triple_keys // count % count, triple_keys % count], axis=1)
        sides = [three[:, i] * count + three[:, j] for i, j in ((0, 1), (1, 2), (0, 2))]
        connected = sum(np.isin(side, touching).astype(int) for side in sides) >= 2
        for side in sides:
            of_three = of_three + _look_up(keys, of_two, side)
        groups = np.stack([keys // count, keys % count, keys % count], axis=1)[near]
        return np.concatenate([groups, three[connected]]), np.concatenate([of_two[near], of_three[connected]])

    def _move(self, labels: Int64Array) -> bool:
        """Move single nodes to a neighbouring part, or to one of their own."""
        changed = False
        waiting = np.arange(self.problem.nodes)
        while len(waiting):
            touched: list[Int64Array] = []
            for node in waiting:
                target = self._better_part(int(node), labels)
                if target is not None:
                    labels[node] = target
                    touched.append(self._near(int(node)))
                    changed = True
            waiting = np.unique(np.concatenate(touched)) if touched else np.zeros(0, np.int64)
        return changed

    def _better_part(self, node: int, labels: Int64Array) -> int | None:
        neighbours = self.edge_other[self.edge_starts[node] : self.edge_starts[node + 1]]
        pairs = slice(self.pair_starts[node], self.pair_starts[node + 1])
        triples = slice(self.triple_starts[node], self.triple_starts[node + 1])
        pair_parts, pair_costs = labels[self.pair_other[pairs]], self.pair_cost[pairs]
        triple_parts, triple_costs = labels[self.triple_others[triples]], self.triple_cost[triples]
        whole = triple_parts[:, 0] == triple_parts[:, 1]
        parts = np.concatenate([pair_parts, triple_parts[whole, 0]])
        costs = np.concatenate([pair_costs, triple_costs[whole]])
        own = int(labels[node])
        staying = float(costs[parts == own].sum())
        best, target = min(0.0, staying) - _GAIN, None
        if staying > _GAIN:
            best, target = -_GAIN, int(labels.max()) + 1
        for part in np.unique(labels[neighbours]):
            cost = float(costs[parts == part].sum())
            if part != own and cost < best:
                best, target = cost, int(part)
        if target is None or not self._stays_connected(node, labels, neighbours):
            return None
        return target

    def _stays_connected(self, node: int, labels: Int64Array, neighbours: Int64Array) -> bool:
        """Whether the node's part holds together without it."""
        own = labels[node]
        left = {int(n) for n in neighbours[labels[neighbours] == own]}
        if len(left) <= 1:
            return True
        start = left.pop()
        seen, todo = {node, start}, [start]
        while todo and left:
            at = todo.pop()
            around = self.edge_other[self.edge_starts[at] : self.edge_starts[at + 1]]
            for other in around[labels[around] == own].tolist():
                if other not in seen:
                    seen.add(other)
                    left.discard(other)
                    # What was the node's neighbour is looked at first: a short way round is the rule.
                    todo.append(other)
        return not left

    def _near(self, node: int) -> Int64Array:
        return np.concatenate(
            [
                self.edge_other[self.edge_starts[node] : self.edge_starts[node + 1]],
                self.pair_other[self.pair_starts[node] : self.pair_starts[node + 1]],
                self.triple_others[self.triple_starts[node] : self.triple_starts[node + 1]].ravel(),
            ]
        )


def _sums(keys: Int64Array, values: Float64Array) -> tuple[Int64Array, Float64Array]:
    """The sum of the values of each key, by rising key."""
    unique, index = np.unique(keys, return_inverse=True)
    return unique, np.asarray(np.bincount(index, weights=values, minlength=len(unique)), dtype=np.float64)


def _look_up(keys: Int64Array, values: Float64Array, wanted: Int64Array) -> Float64Array:
    """Values of wanted keys, 0 for those that are not there."""
    if not len(keys):
        return np.zeros(len(wanted))
    at = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
    return np.where(keys[at] == wanted, values[at], 0.0)


def _by_node(
    count: int, pairs: Int64Array, swap: tuple[int, int], *values: Float64Array
) -> tuple[Int64Array, tuple[NDArray[Any], ...]]:
    """Both directions of pairs (P, 2), by their first node: (N + 1,) starts, the other node, and the values."""
    both = np.concatenate([pairs, pairs[:, swap]])
    order = np.argsort(both[:, 0], kind="stable")
    starts = np.searchsorted(both[order, 0], np.arange(count + 1))
    return starts, (both[order, 1], *(np.tile(value, 2)[order] for value in values))
