"""The second-order part of the solver: greedy additive edge contraction, then Kernighan-Lin with joins.

Both are those of `bioimage-cpp`, which knows pairs alone. A triple is spread over its three pairs: of three nodes,
none, one or all three pairs are together, and c / 3 a pair is right for none and all.
Around a partition that holds one of
the three pairs together, 0 for that pair and c / 2 for the two others is right as well.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from objectflow.errors import MissingExtraError
from objectflow.methods.baselines.homc.problem import Problem
from objectflow.typing import Float64Array, Int64Array


def import_solver() -> Any:
    """`bioimage_cpp.graph`.

    Raises:
        MissingExtraError: it is not installed.
    """
    try:
        from bioimage_cpp import graph
    except ImportError as error:
        raise MissingExtraError('homc needs bioimage-cpp: pip install "objectflow[baselines]"') from error
    return graph


def spread_triples(
    problem: Problem, labels: Int64Array | None, share: float = 1 / 3
) -> tuple[Int64Array, Float64Array]:
    """Pairs (P, 2), each once with the smaller node first, and costs (P,) that stand for pairs and triples.

    Args:
        problem: what is to be solved.
        labels: (N,) the partition around which a triple's costs shall be right; None for none.
        share: of a triple's costs to each of its pairs where nothing better is known.
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
    """A partition for pairs alone, from a partition (N,) or, without one, from nothing joined.

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
    # There, weights are paid for being cut.
    objective = graph.lifted_multicut.LiftedMulticutObjective(base, -costs[is_edge], **lifted)
    if start is None:
        graph.lifted_multicut.LiftedGreedyAdditiveMulticut().optimize(objective)
    else:
        objective.labels = start.astype(np.uint64)
    labels = graph.lifted_multicut.LiftedKernighanLinMulticut().optimize(objective)
    return np.asarray(labels, dtype=np.int64)
