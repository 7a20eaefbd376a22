"""Errors of the rigid motions of matched objects."""

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
"""Limits of a good motion; the share of motions below both is reported."""


@dataclass(frozen=True)
class ObjectError:
    """The error of a matched object's motion.

    Attributes:
        label: of the true object.
        f: F-measure of its mask.
        rotation_deg: smallest error over the object's symmetry group; NaN if the true rotation is unknown.
        translation_cm: distance between the positions to which the two motions take the object's true centre.
        moving: whether the true object moves.
    """

    label: int
    f: float
    rotation_deg: float
    translation_cm: float
    moving: bool

    @property
    def good(self) -> bool:
        """Whether the error is under 5 degrees (if the rotation is known) and under 2 cm."""
        return self.translation_cm < GOOD_CM and not self.rotation_deg >= GOOD_DEG


def score_objects(
    predicted: Iterable[ObjectMotion], truth: PairTruth, matches: Iterable[ObjectMatch]
) -> tuple[ObjectError, ...]:
    """The error of every matched object that is visible in both frames; others have no observable motion.

    Args:
        predicted: the predicted objects.
        truth: of the pair.
        matches: matched objects, from `SegmentationScore.matches`.
    """
    motions = {obj.id: obj for obj in predicted}
    objects = {obj.label: obj for obj in truth.objects}
    return tuple(
        _object_error(motions[match.predicted], objects[match.true], match.f, match.true in truth.moving)
        for match in matches
        if match.predicted in motions and objects[match.true].in_both
    )


def translation_error(predicted: ObjectMotion, true: TrueObject) -> float:
    """Distance in cm between the true centre X under two motions; symmetries of the object leave X in place."""
    moved = geometry.transform(predicted.prev_T_curr, true.center)
    return float(100 * np.linalg.norm(moved - geometry.transform(true.prev_T_curr, true.center)))


def _object_error(predicted: ObjectMotion, true: TrueObject, f: float, moving: bool) -> ObjectError:
    rotation = float("nan")
    if true.rotation_known:
        rotation = rotation_error(predicted.prev_T_curr[:3, :3], true.prev_T_curr[:3, :3], true.axes, true.orders)
    return ObjectError(true.label, f, rotation, translation_error(predicted, true), moving)
