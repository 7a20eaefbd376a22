"""Selection of the pairs in a gallery of limited size: the worst, the best and some between."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from objectflow.evaluation.results import Evaluation


def choose_pairs(evaluation: Evaluation, max_pairs: int) -> list[int]:
    """Indices of the chosen pairs in the set's order; all pairs if there are at most `max_pairs`.

    One third have the lowest and one third the highest mean-F, averaged over all methods except oracles (a failure
    counts as 0); the others are spread evenly over the ranks between.
    """
    count = len(evaluation.pairs)
    if count <= max_pairs:
        return list(range(count))
    order = rank_pairs(evaluation)
    worst, best = math.ceil(max_pairs / 3), max_pairs // 3
    middle = order[worst : count - best]
    ranks = np.linspace(0, len(middle) - 1, max_pairs - worst - best).round().astype(int)
    return sorted([*order[:worst], *(middle[rank] for rank in ranks), *order[count - best :]])


def rank_pairs(evaluation: Evaluation) -> list[int]:
    """Indices of the pairs by increasing mean-F."""
    methods = [method for method in evaluation.methods if not method.oracle] or list(evaluation.methods)
    tables = [{score.key: score.segmentation.mean_f.f for score in method.scores} for method in methods]
    means: Sequence[float] = [sum(table.get(pair.key, 0.0) for table in tables) for pair in evaluation.pairs]
    return sorted(range(len(means)), key=lambda index: (means[index], index))
