"""All metrics of one pair."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from objectflow.evaluation.data.truth import PairTruth
from objectflow.evaluation.metrics.flow_metrics import FlowScore, score_flow
from objectflow.evaluation.metrics.mover_metrics import NO_MOVERS, MoverScore, score_movers
from objectflow.evaluation.metrics.object_metrics import ObjectError, score_objects
from objectflow.evaluation.metrics.region_scores import RegionScore, score_regions
from objectflow.evaluation.metrics.segmentation_metrics import SegmentationScore, score_segmentation
from objectflow.motion import SceneMotion


@dataclass(frozen=True)
class PairScore:
    """The scores of one method's result on one pair.

    Attributes:
        key, scene: of the pair.
        flow, segmentation: scores of the image.
        objects: errors of the matched objects.
        seconds: runtime of the estimate.
        regions: scores of every true object, matched or not.
        movers: detection of the moving objects.
    """

    key: str
    scene: str
    flow: FlowScore
    segmentation: SegmentationScore
    objects: tuple[ObjectError, ...]
    seconds: float
    regions: tuple[RegionScore, ...] = ()
    movers: MoverScore = NO_MOVERS


def score_pair(predicted: SceneMotion, truth: PairTruth) -> PairScore:
    """Score one result.

    Raises:
        ResultError: the result is of another size than the truth.
    """
    segmentation = score_segmentation(truth.labels, predicted.labels)
    moving = np.zeros(int(truth.labels.max(initial=0)) + 1, np.bool_)
    moving[list(truth.moving)] = True
    return PairScore(
        key=truth.key,
        scene=truth.scene,
        flow=score_flow(predicted.scene_flow, truth.scene_flow, truth.masked, moving[truth.labels]),
        segmentation=segmentation,
        objects=score_objects(predicted.objects, truth, segmentation.matches),
        seconds=predicted.seconds,
        regions=score_regions(predicted.scene_flow, truth, segmentation.matches),
        movers=score_movers(predicted, truth),
    )
