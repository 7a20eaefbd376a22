"""What moved and what did not: each object's motion against standing still, by what the previous frame shows.

A network is never wholly still: where depth is noisy, or where something else was lifted away, it says that things
moved a little. The frames can refute that.
"""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import numpy as np

from objectflow.alignment.likelihood import COST_FREE_SPACE_VIOLATION
from objectflow.alignment.moved import is_moving
from objectflow.methods.postprocess.pair_likelihood import PairLikelihood
from objectflow.motion import ObjectMotion
from objectflow.typing import Float32Array

MIN_GAIN = 0.2
"""Mean log-likelihood a pixel that a motion has to win over standing still."""
INLIER_COST = 1.0
"""Cost up to which a pixel is explained."""
STATIC_INLIER_RATIO = 0.2
"""Share of an object's pixels that standing still explains: with as many it does not speak against it."""
FREE_SPACE_VIOLATION_RATIO = 0.02
"""Share of the pixels that, standing still, would hang in front of what was seen: a few do at any depth edge."""
NETWORK_CONFIDENCE = 0.6
"""Probability of an object from which the network is believed where the frames say nothing."""


class MotionEvidence(NamedTuple):
    """What the previous frame says of one object.

    Attributes:
        gain: mean log-likelihood of a pixel under the object's motion, less that of standing still.
        stands: share of the pixels that standing still explains.
        impossible: share of the pixels that, had they stood still, would hang in front of what was seen.
    """

    gain: float
    stands: float
    impossible: float

    def moved(self, score: float) -> bool:
        """Whether the object moved.

        It did if its motion explains it better than standing still does. A wrong motion explains nothing; then it
        moved if it cannot have stood still, or, if it would merely have been hidden, by the network's word: what was
        lifted away leaves hidden things behind that never moved.

        Args:
            score: 0..1, how sure the network is.
        """
        if self.gain > MIN_GAIN:
            return True
        return self.stands < STATIC_INLIER_RATIO and (
            self.impossible > FREE_SPACE_VIOLATION_RATIO or score > NETWORK_CONFIDENCE
        )


def reject_static(likelihood: PairLikelihood, objects: tuple[ObjectMotion, ...]) -> tuple[ObjectMotion, ...]:
    """Give objects that stand still, as far as the frames can tell, the identity for a motion, and say so.

    Args:
        likelihood: the frames, with the objects' labels.
        objects: with their final motions.

    Returns:
        The same objects. `moving` is decided anew: by the motion's size, and by `MotionEvidence`.
    """
    out = []
    for obj in objects:
        moving = bool(is_moving(obj.prev_T_curr[:3, :3], obj.translation))
        motion = obj.prev_T_curr
        if moving:
            found = find_evidence(likelihood, obj)
            moving = found is None or found.moved(obj.score)
            motion = motion if moving else np.eye(4)
        out.append(dataclasses.replace(obj, prev_T_curr=motion, moving=moving))
    return tuple(out)


def find_evidence(likelihood: PairLikelihood, obj: ObjectMotion) -> MotionEvidence | None:
    """The evidence on one object; None where none of its pixels has depth."""
    mask = likelihood.mask(obj.id)
    if not mask.any():
        return None
    still: Float32Array = likelihood.cost(np.eye(4), mask)
    return MotionEvidence(
        gain=float((still - likelihood.cost(obj.prev_T_curr, mask)).mean()),
        stands=float((still < INLIER_COST).mean()),
        impossible=float((still >= COST_FREE_SPACE_VIOLATION).mean()),
    )
