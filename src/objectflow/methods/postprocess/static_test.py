"""The static test: whether an object moved, by its motion's likelihood against that of standing still.

Networks predict small spurious motions where depth is noisy or where another object was lifted away.
"""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import cv2
import numpy as np

from objectflow import geometry
from objectflow.alignment.frame_pair import FramePair
from objectflow.geometry.moved import displaces
from objectflow.methods.labels import Objects
from objectflow.methods.postprocess.pair_likelihood import PairLikelihood
from objectflow.methods.postprocess.settings import PostprocessSettings, StaticTestSettings
from objectflow.methods.postprocess.uncovered import RestingCosts
from objectflow.motion import ObjectMotion
from objectflow.typing import LabelImage


class MotionEvidence(NamedTuple):
    """Evidence that an object moved.

    Attributes:
        gain: mean log-likelihood of a pixel under the object's motion minus that of standing still.
        static_inliers: share of the pixels that standing still explains.
        violations: share of the pixels that would violate free space if they had stood still.
    """

    gain: float
    static_inliers: float
    violations: float

    def moved(self, score: float, settings: StaticTestSettings) -> bool:
        """Whether the object moved.

        It moved if its motion explains it better than standing still does. A wrong motion explains nothing; then the
        object moved if it cannot have stood still, or, where it would merely have been hidden, if the network is
        confident: lifting an object away uncovers hidden objects that never moved.

        Args:
            score: 0..1, the network's probability of the object.
            settings: see there.
        """
        if self.gain > settings.min_gain:
            return True
        violates = self.violations > settings.free_space_violation_ratio
        return self.static_inliers < settings.static_inlier_ratio and (violates or score > settings.network_confidence)


def reject_static(
    pair: FramePair, labels: LabelImage, objects: Objects, settings: PostprocessSettings
) -> tuple[LabelImage, Objects]:
    """Give objects without evidence of motion the identity as motion, and mark them as static.

    Args:
        pair: the frames, from a static camera.
        labels: (H, W) int32.
        objects: with their motions.
        settings: `static_test` and `likelihood` apply.

    Returns:
        The same labels and objects; `moving` is decided anew by the size of the motion and the evidence.
    """
    likelihood = PairLikelihood.of(pair, settings.likelihood)
    small, test = likelihood.downscale(labels), settings.static_test
    resting = RestingCosts(likelihood, small, objects, test)
    out = []
    for obj in objects:
        points = likelihood.points[likelihood.mask(small, obj.id)]
        moving = displaces(obj.prev_T_curr, points, obj.center, test.static_displacement)
        motion = obj.prev_T_curr
        if moving:
            evidence = find_evidence(likelihood, small, obj, resting, settings)
            moving = evidence is not None and evidence.moved(obj.score, test)
            moving = moving and not _is_shadow(likelihood, small, obj, objects, test)
            motion = motion if moving else np.eye(4)
        out.append(dataclasses.replace(obj, prev_T_curr=motion, moving=moving))
    return labels, tuple(out)


def rest_hidden(
    pair: FramePair, labels: LabelImage, objects: Objects, settings: PostprocessSettings
) -> tuple[LabelImage, Objects]:
    """Give objects the identity as motion that may have been hidden before, where no motion explains them better.

    What lies behind an object that left is uncovered by it. The network may take it for an object that moved; at the
    end of all searches, no motion explains it better than standing still, which contradicts nothing.

    Args:
        pair: the frames, from a static camera.
        labels: (H, W) int32.
        objects: with their final motions.
        settings: `static_test` and `likelihood` apply.

    Returns:
        The same labels and objects; those that may have been hidden are static.
    """
    likelihood = PairLikelihood.of(pair, settings.likelihood)
    small = likelihood.downscale(labels)
    resting = RestingCosts(likelihood, small, objects, settings.static_test)
    out = []
    for obj in objects:
        mask, rests = likelihood.mask(small, obj.id), False
        if obj.moving and mask.any():
            static = resting.of(obj.id)
            gain = float((static - likelihood.cost(obj.prev_T_curr, mask)).mean())
            rests = gain <= 0 and float(static.mean()) <= settings.static_test.hidden_cost
        out.append(dataclasses.replace(obj, prev_T_curr=np.eye(4), moving=False) if rests else obj)
    return labels, tuple(out)


def _is_shadow(
    likelihood: PairLikelihood, small: LabelImage, obj: ObjectMotion, objects: Objects, settings: StaticTestSettings
) -> bool:
    """Whether an object is a change of colour alone beside a larger mover: its shadow or its reflection.

    Light explains the colours of most shadows. A reflection follows its mover. What moved along a surface of its own
    depth does neither.
    """
    mask = likelihood.mask(small, obj.id)
    depth, hidden = likelihood.static_depth_cost()
    unchanged = (depth[mask] < settings.inlier_cost) & ~hidden[mask]
    if unchanged.mean() < settings.shadow_depth_ratio:
        return False
    size = 2 * settings.shadow_reach_px + 1
    near = np.unique(small[cv2.dilate(mask.astype(np.uint8), np.ones((size, size), np.uint8)) > 0])
    movers = [one for one in objects if one.moving and one.id != obj.id and one.id in near]
    movers = [one for one in movers if one.pixels * settings.shadow_area_ratio > obj.pixels]
    if likelihood.cost_at_rest(mask).mean() <= settings.shadow_cost:
        return bool(movers)
    points = likelihood.points[mask]
    end = geometry.transform(obj.prev_T_curr, points)
    largest = settings.shadow_motion_ratio * float(np.linalg.norm(end - points, axis=1).mean())
    apart = [np.linalg.norm(geometry.transform(one.prev_T_curr, points) - end, axis=1).mean() for one in movers]
    return min(map(float, apart), default=np.inf) < largest


def find_evidence(
    likelihood: PairLikelihood,
    small: LabelImage,
    obj: ObjectMotion,
    resting: RestingCosts,
    settings: PostprocessSettings,
) -> MotionEvidence | None:
    """The evidence on one object; None where none of its pixels has depth, which is no evidence of a motion."""
    mask = likelihood.mask(small, obj.id)
    if not mask.any():
        return None
    static = resting.of(obj.id)
    return MotionEvidence(
        gain=float((static - likelihood.cost(obj.prev_T_curr, mask)).mean()),
        static_inliers=float((static < settings.static_test.inlier_cost).mean()),
        violations=float((static >= settings.likelihood.free_space_violation).mean()),
    )
