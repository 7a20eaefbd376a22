"""Mask and flow scores of each true object, for the breakdowns by displacement, rotation and size."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from objectflow.evaluation.data.truth import PairTruth
from objectflow.evaluation.metrics.flow_metrics import end_point_errors
from objectflow.evaluation.metrics.segmentation_metrics import ObjectMatch
from objectflow.typing import Float32Array


@dataclass(frozen=True)
class RegionScore:
    """The scores of one true object.

    Attributes:
        label: of the true object.
        f: F-measure of the mask that is matched to it; 0 without a match.
        epe_cm: mean end-point error over its pixels with truth and prediction; NaN without such pixels.
    """

    label: int
    f: float
    epe_cm: float


def score_regions(
    predicted: Float32Array, truth: PairTruth, matches: Iterable[ObjectMatch]
) -> tuple[RegionScore, ...]:
    """Score every object of the truth.

    Args:
        predicted: (H, W, 3) flow in metres.
        truth: of the pair.
        matches: matched objects, from `SegmentationScore.matches`.
    """
    f = {match.true: match.f for match in matches}
    pixels = np.flatnonzero(truth.labels)
    a, b = (np.ascontiguousarray(flow.reshape(-1, 3)[pixels].T, np.float64) for flow in (predicted, truth.scene_flow))
    errors = end_point_errors(a, b)
    finite = np.isfinite(errors)
    owners = truth.labels.ravel()[pixels[finite]]
    size = int(truth.labels.max(initial=0)) + 1
    count, total = np.bincount(owners, minlength=size), np.bincount(owners, errors[finite], minlength=size)
    return tuple(
        RegionScore(
            obj.label,
            f.get(obj.label, 0.0),
            float(total[obj.label] / count[obj.label]) if count[obj.label] else float("nan"),
        )
        for obj in truth.objects
    )
