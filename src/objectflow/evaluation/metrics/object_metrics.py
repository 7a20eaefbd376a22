"""The error of each found object's rigid motion."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from objectflow import geometry
from objectflow.evaluation.data.truth import PairTruth, TrueObject
from objectflow.evaluation.metrics.segmentation_metrics import ObjectMatch
from objectflow.evaluation.metrics.symmetry_error import rotation_error
from objectflow.motion import ObjectMotion

GOOD_DEG, GOOD_CM = 5.0, 2.0
"""The share of motions better than both is reported."""


@dataclass(frozen=True)
class ObjectError:
    """How far a found object's motion is off.

    Attributes:
        label: of the true object.
        f: F-measure of its mask.
        rotation_deg: smallest over the object's symmetry group; NaN where the truth has no rotation.
        translation_cm: distance between where the two motions take the object's true centre.
        moving: whether it really moves.
    """

    label: int
    f: float
    rotation_deg: float
    translation_cm: float
    moving: bool

    @property
    def good(self) -> bool:
        """Under 5 degrees (where the rotation is known) and under 2 cm."""
        return self.translation_cm < GOOD_CM and not self.rotation_deg >= GOOD_DEG


def score_objects(
    predicted: Iterable[ObjectMotion], truth: PairTruth, matches: Iterable[ObjectMatch]
) -> tuple[ObjectError, ...]:
    """The error of every matched object that is visible in both frames; one seen in one frame shows no motion.

    Args:
        predicted: the found objects.
        truth: of the pair.
        matches: pairs of objects, of `SegmentationScore.matches`.
    """
    motions = {obj.id: obj for obj in predicted}
    objects = {obj.label: obj for obj in truth.objects}
    return tuple(
        _object_error(motions[match.predicted], objects[match.true], match.f, match.true in truth.moving)
        for match in matches
        if match.predicted in motions and objects[match.true].in_both
    )


def translation_error(predicted: ObjectMotion, true: TrueObject) -> float:
    """Centimetres between where two motions take the true centre X, which no turn of the symmetry group moves."""
    carried = geometry.transform(predicted.prev_T_curr, true.center)
    return float(100 * np.linalg.norm(carried - geometry.transform(true.prev_T_curr, true.center)))


def _object_error(predicted: ObjectMotion, true: TrueObject, f: float, moving: bool) -> ObjectError:
    rotation = float("nan")
    if true.rotation_known:
        rotation = rotation_error(predicted.prev_T_curr[:3, :3], true.prev_T_curr[:3, :3], true.axes, true.orders)
    return ObjectError(true.label, f, rotation, translation_error(predicted, true), moving)
