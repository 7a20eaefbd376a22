"""Detection of moving objects: those that are found, and false ones."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from objectflow.dataset.moving_objects import keep_labels
from objectflow.evaluation.data.truth import PairTruth
from objectflow.evaluation.metrics.region_matching import assign_regions, compare
from objectflow.evaluation.metrics.segmentation_metrics import EXTRACTED
from objectflow.motion import SceneMotion

MIN_AREA_RATIO = 60 / (320 * 240)
"""Minimum share of the image's pixels of an object that must be found; finding a smaller one is not an error."""


@dataclass(frozen=True)
class MoverScore:
    """The moving objects of one pair.

    Attributes:
        true: number of moving objects to be found: visible in both frames and at least `MIN_AREA_RATIO` large.
        predicted: number of objects predicted to move, except those matched to a moving object outside `true`.
        found: number of true ones matched by a predicted one with F >= 0.75.
        static: nothing in the pair moves.
    """

    true: int
    predicted: int
    found: int
    static: bool

    @property
    def false_mover(self) -> bool:
        """Whether an object is predicted to move in a pair without motion."""
        return self.static and self.predicted > 0


NO_MOVERS = MoverScore(true=0, predicted=0, found=0, static=False)
"""The score of a pair that was not scored for moving objects."""


def score_movers(predicted: SceneMotion, truth: PairTruth) -> MoverScore:
    """Compare the objects that a method predicts to move with those that do; static predictions are ignored.

    Raises:
        ResultError: the result is of another size than the truth.
    """
    true = keep_labels(truth.labels, truth.moving)
    guess = keep_labels(predicted.labels, {obj.id for obj in predicted.objects if obj.moving})
    regions = compare(true, guess).without_background()
    both = {obj.label for obj in truth.objects if obj.in_both}
    required = np.array([int(label) in both for label in regions.true_ids], dtype=np.bool_)
    required &= regions.true_sizes >= MIN_AREA_RATIO * true.size
    pairs = assign_regions(regions)
    found = sum(bool(required[i]) and regions.f[i, j] >= EXTRACTED for i, j in pairs)
    ignored = sum(not required[i] for i, _ in pairs)
    return MoverScore(int(required.sum()), len(regions.predicted_ids) - ignored, found, not truth.moving)
