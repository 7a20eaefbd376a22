"""The second-order part of the solver: greedy additive edge contraction, then Kernighan-Lin with joins.

Both are implemented by `bioimage-cpp` for pair costs only, so the cost c of a triple is spread over its three pairs.
A partition joins none, one or all three of the pairs. A share of c / 3 per pair is exact for none and all. For a
partition that joins exactly one pair, shares of 0 for that pair and c / 2 for the others are exact.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from objectflow.errors import MissingExtraError
from objectflow.methods.baselines.homc.problem import Problem
from objectflow.typing import Float64Array, Int64Array


def import_solver() -> Any:
    """Import `bioimage_cpp.graph`.

    Raises:
        MissingExtraError: `bioimage-cpp` is not installed.
    """
    try:
        from bioimage_cpp import graph
    except ImportError as error:
        raise MissingExtraError("homc needs bioimage-cpp", "baselines") from error
    return graph


def spread_triples(
    problem: Problem, labels: Int64Array | None, share: float = 1 / 3
) -> tuple[Int64Array, Float64Array]:
    """Approximate pair and triple costs by pair costs.

    Args:
        problem: the problem.
        labels: (N,) partition for which the approximation is exact, or None.
        share: share of a triple's cost that each of its pairs gets without a partition.

    Returns:
        (P, 2) unique pairs with the smaller node first, and (P,) costs.
    """
    a, b, c = problem.triples.T
    sides = np.concatenate([problem.triples[:, [0, 1]], problem.triples[:, [1, 2]], problem.triples[:, [0, 2]]])
    shares = np.full((3, len(a)), share)
    if labels is not None:
        together = np.stack([labels[a] == labels[b], labels[b] == labels[c], labels[a] == labels[c]])
        shares = np.where(together.sum(0) == 1, np.where(together, 0.0, 0.5), shares)
    pairs = np.sort(np.concatenate([problem.edges, problem.pairs, sides]), axis=1)
    costs = np.concatenate([np.zeros(len(problem.edges)), problem.pair_costs, (shares * problem.triple_costs).ravel()])
    keys, index = np.unique(pairs[:, 0] * problem.nodes + pairs[:, 1], return_inverse=True)
    unique = np.stack([keys // problem.nodes, keys % problem.nodes], axis=1)
    return unique, np.asarray(np.bincount(index, weights=costs, minlength=len(keys)), dtype=np.float64)


def solve_pairs(problem: Problem, pairs: Int64Array, costs: Float64Array, start: Int64Array | None) -> Int64Array:
    """Partition the nodes by pair costs, starting from a partition (N,) or, if None, from greedy contraction.

    Raises:
        MissingExtraError: `bioimage-cpp` is not installed.
    """
    graph = import_solver()
    edges = np.unique(np.sort(problem.edges, axis=1), axis=0)
    is_edge = np.isin(pairs[:, 0] * problem.nodes + pairs[:, 1], edges[:, 0] * problem.nodes + edges[:, 1])
    base = graph.UndirectedGraph(problem.nodes)
    base.insert_edges(pairs[is_edge].astype(np.uint64))
    lifted: dict[str, Any] = {}
    if not is_edge.all():
        lifted = {"lifted_uvs": pairs[~is_edge].astype(np.uint64), "lifted_costs": -costs[~is_edge]}
    # The library's weights are costs of cutting.
    objective = graph.lifted_multicut.LiftedMulticutObjective(base, -costs[is_edge], **lifted)
    if start is None:
        graph.lifted_multicut.LiftedGreedyAdditiveMulticut().optimize(objective)
    else:
        objective.labels = start.astype(np.uint64)
    labels = graph.lifted_multicut.LiftedKernighanLinMulticut().optimize(objective)
    return np.asarray(labels, dtype=np.int64)
