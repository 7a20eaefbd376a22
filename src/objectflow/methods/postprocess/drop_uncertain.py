"""The removal of objects that neither the network's probability nor the frames support."""

from __future__ import annotations

from objectflow.alignment.frame_pair import FramePair
from objectflow.methods.labels import Objects, relabel_present
from objectflow.methods.postprocess.pair_likelihood import PairLikelihood
from objectflow.methods.postprocess.settings import PostprocessSettings
from objectflow.motion import ObjectMotion
from objectflow.typing import BoolMask, LabelImage


def drop_uncertain(
    pair: FramePair, labels: LabelImage, objects: Objects, settings: PostprocessSettings
) -> tuple[LabelImage, Objects]:
    """Remove objects of low probability that the frames do not support.

    Static objects are removed unless standing still does not explain them, since they may have moved although no
    motion was found. Moving objects are removed if they are small and their motion does not explain them; tiny ones
    must be more probable to stay.

    Args:
        pair: the frames, from a static camera.
        labels: (H, W) int32.
        objects: with the network's probability as their score.
        settings: `min_static_score`, `min_unexplained_score`, `min_unexplained_share`, `min_tiny_score`,
            `tiny_share`, `unexplained_cost` and `likelihood` apply.

    Returns:
        Labels and objects, numbered anew from 1.
    """
    likelihood = PairLikelihood.of(pair, settings.likelihood)
    small = likelihood.downscale(labels)
    kept = tuple(obj for obj in objects if _is_certain(likelihood, likelihood.mask(small, obj.id), obj, settings))
    return relabel_present(labels, kept)


def _is_certain(likelihood: PairLikelihood, mask: BoolMask, obj: ObjectMotion, settings: PostprocessSettings) -> bool:
    """Whether an object is probable, or the frames support it; see `drop_uncertain`."""
    tiny = obj.moving and 0 < float(mask.mean()) < settings.tiny_share
    if obj.score >= (settings.min_tiny_score if tiny else settings.min_static_score):
        return True
    if not mask.any():
        return False
    if obj.moving:
        explained = float(likelihood.cost(obj.prev_T_curr, mask).mean()) < settings.unexplained_cost
        return explained or float(mask.mean()) >= settings.min_unexplained_share
    unexplained = float(likelihood.cost_at_rest(mask).mean()) >= settings.unexplained_cost
    return unexplained and obj.score >= settings.min_unexplained_score
