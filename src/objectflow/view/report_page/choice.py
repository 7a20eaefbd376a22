"""Which pairs a gallery of limited size shows: the worst, the best, and some in between."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from objectflow.evaluation.results import Evaluation


def choose_pairs(evaluation: Evaluation, most: int) -> list[int]:
    """Numbers of the chosen pairs, in the set's order; all of them if they are not more than `most`.

    A third each are those with the lowest and with the highest mean-F, averaged over the methods that compete (a
    failure counts as 0); the others are evenly spread over the ranks between.
    """
    count = len(evaluation.pairs)
    if count <= most:
        return list(range(count))
    order = rank_pairs(evaluation)
    worst, best = math.ceil(most / 3), most // 3
    middle = order[worst : count - best]
    places = np.linspace(0, len(middle) - 1, most - worst - best).round().astype(int)
    return sorted([*order[:worst], *(middle[place] for place in places), *order[count - best :]])


def rank_pairs(evaluation: Evaluation) -> list[int]:
    """Numbers of the pairs, the hardest first."""
    methods = [method for method in evaluation.methods if not method.oracle] or list(evaluation.methods)
    tables = [{score.key: score.segmentation.mean_f.f for score in method.scores} for method in methods]
    means: Sequence[float] = [sum(table.get(pair.key, 0.0) for table in tables) for pair in evaluation.pairs]
    return sorted(range(len(means)), key=lambda index: (means[index], index))
