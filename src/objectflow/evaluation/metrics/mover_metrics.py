"""Which of the moving objects are found, and what is taken for one that is none."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from objectflow.dataset.moving_objects import keep_labels
from objectflow.evaluation.data.truth import PairTruth
from objectflow.evaluation.metrics.region_matching import assign_regions, compare
from objectflow.evaluation.metrics.segmentation_metrics import EXTRACTED
from objectflow.motion import SceneMotion

LEAST_SHARE = 60 / (320 * 240)
"""Of the image: a moving object of fewer pixels need not be found, nor is it an error to find it."""


@dataclass(frozen=True)
class MoverScore:
    """The moving objects of one pair.

    Attributes:
        true: that are to be found: those that move, that both frames show, and that are no mere speck.
        predicted: that were found to move, but for those that stand for a moving object that need not be found.
        found: true ones that a predicted one stands for with F >= 0.75.
        still: nothing in the pair moves at all.
    """

    true: int
    predicted: int
    found: int
    still: bool

    @property
    def false_mover(self) -> bool:
        """Something was taken to move where nothing does."""
        return self.still and self.predicted > 0


NO_MOVERS = MoverScore(true=0, predicted=0, found=0, still=False)
"""Nothing was looked for."""


def score_movers(predicted: SceneMotion, truth: PairTruth) -> MoverScore:
    """Score the objects that a method says move against those that do; objects that it says stand still do not count.

    Raises:
        ResultError: the result is of another size than the truth.
    """
    true = keep_labels(truth.labels, truth.moving)
    guess = keep_labels(predicted.labels, {obj.id for obj in predicted.objects if obj.moving})
    regions = compare(true, guess).without_background()
    both = {obj.label for obj in truth.objects if obj.in_both}
    wanted = np.array([int(label) in both for label in regions.true_ids], dtype=np.bool_)
    wanted &= regions.true_sizes >= LEAST_SHARE * true.size
    pairs = assign_regions(regions)
    found = sum(bool(wanted[i]) and regions.f[i, j] >= EXTRACTED for i, j in pairs)
    excused = sum(not wanted[i] for i, _ in pairs)
    return MoverScore(int(wanted.sum()), len(regions.predicted_ids) - excused, found, not truth.moving)
