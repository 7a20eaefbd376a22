"""The solver of higher-order lifted multicuts, against all partitions of small graphs and on planted partitions."""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import numpy as np
import pytest

from objectflow.methods.baselines.homc import multicut, search
from objectflow.methods.baselines.homc.problem import Problem
from objectflow.typing import Int64Array

pytest.importorskip("bioimage_cpp")

NO_PAIRS, NO_TRIPLES = np.zeros((0, 2), np.int64), np.zeros((0, 3), np.int64)


def partitions(count: int) -> Iterator[Int64Array]:
    """All partitions of `count` nodes."""

    def grow(labels: list[int], parts: int) -> Iterator[Int64Array]:
        if len(labels) == count:
            yield np.array(labels)
            return
        for part in range(parts + 1):
            yield from grow([*labels, part], max(parts, part + 1))

    yield from grow([], 0)


def all_of(count: int, size: int) -> Int64Array:
    return np.array(list(itertools.combinations(range(count), size)))


def random_problem(rng: np.random.Generator, count: int) -> Problem:
    """A problem with half of all pairs as edges, costs on 70% of the pairs and half of the triples, normal costs."""
    pairs, triples = all_of(count, 2), all_of(count, 3)
    while True:
        edges = pairs[rng.random(len(pairs)) < 0.5]
        graph = Problem(count, edges, NO_PAIRS, np.zeros(0), NO_TRIPLES, np.zeros(0))
        if len(np.unique(graph.connected(np.zeros(count, np.int64)))) == 1:
            break
    pairs, triples = pairs[rng.random(len(pairs)) < 0.7], triples[rng.random(len(triples)) < 0.5]
    return Problem(count, edges, pairs, rng.standard_normal(len(pairs)), triples, rng.standard_normal(len(triples)))


def canonical(labels: Int64Array) -> list[int]:
    """Labels numbered by first occurrence, so that equal partitions are equal."""
    order: dict[int, int] = {}
    return [order.setdefault(int(label), len(order)) for label in labels]


def test_the_energy_is_the_sum_of_the_costs_of_joined_nodes() -> None:
    rng = np.random.default_rng(0)
    problem = random_problem(rng, 7)
    labels = rng.integers(0, 3, 7)
    expected = sum(c for (p, q), c in zip(problem.pairs, problem.pair_costs, strict=True) if labels[p] == labels[q])
    for triple, cost in zip(problem.triples, problem.triple_costs, strict=True):
        expected += cost if len(set(labels[triple].tolist())) == 1 else 0
    assert np.isclose(problem.energy(labels), expected)


def test_disconnected_parts_are_split() -> None:
    chain = np.array([[0, 1], [1, 2], [2, 3]])
    problem = Problem(4, chain, NO_PAIRS, np.zeros(0), NO_TRIPLES, np.zeros(0))
    assert canonical(problem.connected(np.array([0, 1, 0, 0]))) == [0, 1, 2, 2]
    assert not problem.is_feasible(np.array([0, 1, 0, 0]))
    assert problem.is_feasible(np.array([5, 5, 0, 0]))


def test_solutions_of_small_graphs_are_nearly_optimal() -> None:
    rng = np.random.default_rng(1)
    optimal, gaps = 0, []
    all_partitions = {count: list(partitions(count)) for count in (5, 6, 7)}
    for k in range(45):
        problem = random_problem(rng, 5 + k % 3)
        best = min(problem.energy(labels) for labels in all_partitions[problem.nodes] if problem.is_feasible(labels))
        found = search.solve(problem)
        assert problem.is_feasible(found)
        energy = problem.energy(found)
        assert energy >= best - 1e-9
        optimal += energy <= best + 1e-9
        gaps.append((energy - best) / -best if best < 0 else 0)
    assert optimal >= 40
    assert np.mean(gaps) < 0.05


def test_spread_triple_costs_are_exact_for_the_given_partition() -> None:
    rng = np.random.default_rng(2)
    problem = random_problem(rng, 6)
    singletons, together = np.arange(6), np.zeros(6, np.int64)
    for labels in (rng.integers(0, 2, 6), rng.integers(0, 3, 6), singletons, together):
        pairs, costs = multicut.spread_triples(problem, labels)
        spread = costs[labels[pairs[:, 0]] == labels[pairs[:, 1]]].sum()
        assert np.isclose(spread, problem.energy(labels))
        assert len(np.unique(pairs, axis=0)) == len(pairs)
        assert (pairs[:, 0] < pairs[:, 1]).all()
    pairs, costs = multicut.spread_triples(problem, None)
    assert np.isclose(costs.sum(), problem.energy(together))


def test_the_search_ends_in_a_local_minimum() -> None:
    rng = np.random.default_rng(3)
    for _ in range(10):
        problem = random_problem(rng, 7)
        start = problem.connected(rng.integers(0, 3, 7))
        labels = search.LocalSearch(problem).improve(start)
        energy = problem.energy(labels)
        assert energy <= problem.energy(start) + 1e-9
        assert problem.is_feasible(labels)
        for node, part in itertools.product(range(7), range(8)):
            changed = labels.copy()
            changed[node] = part
            if problem.is_feasible(changed):
                assert problem.energy(changed) >= energy - 1e-8
        for a, b in itertools.combinations(np.unique(labels).tolist(), 2):
            joined = np.where(labels == b, a, labels)
            if problem.is_feasible(joined):
                assert problem.energy(joined) >= energy - 1e-8


def grid_problem(
    planted: Int64Array, rng: np.random.Generator, pair_noise: float, pair_weight: float, triple_weight: float
) -> Problem:
    """A grid with edges between neighbours, whose lifted edges and triples have costs in favour of planted parts."""
    height, width = planted.shape
    node = np.arange(height * width).reshape(height, width)
    edges = np.concatenate([np.stack([node[:, :-1], node[:, 1:]], -1).reshape(-1, 2)])
    edges = np.concatenate([edges, np.stack([node[:-1], node[1:]], -1).reshape(-1, 2)])
    lifted = np.sort(rng.integers(0, node.size, (6 * node.size, 2)), axis=1)
    pairs = np.unique(np.concatenate([edges, lifted[lifted[:, 0] < lifted[:, 1]]]), axis=0)
    corner = np.stack([node[:-1, :-1], node[:-1, 1:], node[1:, :-1]], -1).reshape(-1, 3)
    corner = np.concatenate([corner, np.stack([node[:-1, 1:], node[1:, :-1], node[1:, 1:]], -1).reshape(-1, 3)])
    far = np.sort(rng.integers(0, node.size, (3 * node.size, 3)), axis=1)
    far = far[(far[:, 0] < far[:, 1]) & (far[:, 1] < far[:, 2])]
    triples = np.unique(np.concatenate([corner, far]), axis=0)
    flat = planted.ravel()
    same = flat[pairs[:, 0]] == flat[pairs[:, 1]]
    joined = (flat[triples] == flat[triples[:, :1]]).all(1)
    return Problem(
        nodes=node.size,
        edges=edges,
        pairs=pairs,
        pair_costs=pair_weight * np.where(same, -1.0, 1.0) + pair_noise * rng.standard_normal(len(pairs)),
        triples=triples,
        triple_costs=triple_weight * np.where(joined, -1.0, 1.0),
    )


def planted_parts() -> Int64Array:
    parts = np.zeros((13, 17), np.int64)
    parts[2:7, 2:8], parts[5:11, 9:15], parts[8:11, 2:5] = 1, 2, 3
    return parts


@pytest.mark.parametrize(
    ("pair_noise", "pair_weight", "triple_weight"),
    [(0.0, 1.0, 0.0), (0.3, 1.0, 0.5), (0.0, 0.0, 1.0), (0.5, 0.3, 1.0)],
    ids=["pairs", "both", "triples", "weak pairs"],
)
def test_planted_partitions_are_recovered_exactly(pair_noise: float, pair_weight: float, triple_weight: float) -> None:
    planted = planted_parts()
    for seed in range(3):
        problem = grid_problem(planted, np.random.default_rng(seed), pair_noise, pair_weight, triple_weight)
        found = search.solve(problem)
        assert canonical(found) == canonical(planted.ravel())
        np.testing.assert_array_equal(found, search.solve(problem))


def test_triples_override_wrong_pair_costs() -> None:
    # The pair costs within one part cut, as for a rotating body, while its triple costs join.
    planted = planted_parts()
    problem = grid_problem(planted, np.random.default_rng(4), 0.0, 1.0, 4.0)
    body = (planted.ravel()[problem.pairs] == 2).all(1)
    problem.pair_costs[body] = 0.5
    pairs_only = Problem(problem.nodes, problem.edges, problem.pairs, problem.pair_costs, NO_TRIPLES, np.zeros(0))
    assert canonical(search.solve(problem)) == canonical(planted.ravel())
    assert len(np.unique(search.solve(pairs_only))) > 20


@pytest.mark.parametrize("count", [0, 1, 2])
def test_graphs_of_up_to_two_nodes_are_solved(count: int) -> None:
    edges = np.array([[0, 1]]) if count == 2 else NO_PAIRS
    problem = Problem(count, edges, edges, -np.ones(len(edges)), NO_TRIPLES, np.zeros(0))
    assert search.solve(problem).tolist() == [0] * count
