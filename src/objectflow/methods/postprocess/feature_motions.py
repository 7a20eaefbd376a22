"""Motions of objects from features alone, which find a textured object again however far it moved."""

from __future__ import annotations

import numpy as np

from objectflow.alignment import registration
from objectflow.alignment.camera_motion import CameraMotionSettings, dominant_motion
from objectflow.alignment.frame_pair import FramePair
from objectflow.alignment.matching import PixelMatches, feature_matches, inside
from objectflow.methods.postprocess.pair_likelihood import PairLikelihood
from objectflow.methods.postprocess.search_settings import FeatureMotionSettings
from objectflow.typing import BoolMask, Float64Array


def match_features(pair: FramePair, settings: FeatureMotionSettings) -> PixelMatches:
    """Matched features of the whole frames; they are computed once per pair."""
    key = match_features, settings.matching
    if key not in pair.memo:
        pair.memo[key] = feature_matches(pair.prev, pair.curr, settings.matching)
    found: PixelMatches = pair.memo[key]
    return found


def feature_motion(
    matches: PixelMatches, pair: FramePair, likelihood: PairLikelihood, mask: BoolMask, settings: FeatureMotionSettings
) -> Float64Array | None:
    """The registered motion (4, 4) that most of an object's features follow; None where too few agree.

    Args:
        matches: features of the whole frames, on the pixels of `pair`.
        pair: the frames.
        likelihood: of the pair.
        mask: (H, W) bool of the object, at the size of the likelihood.
        settings: see there.
    """
    camera = pair.curr.frame.camera
    own = matches[inside(mask, matches, camera)]
    search = CameraMotionSettings(min_inliers=settings.min_inliers, trials=settings.trials)
    found = dominant_motion(own, camera, np.random.default_rng(len(own.curr)), noise=pair.noise, settings=search)
    if found is None:
        return None
    small = likelihood.pair
    source = small.sources.take(mask, limit=settings.max_points)
    motion = registration.refine(small.target, source, found[0], settings=settings.registration).prev_T_curr
    return motion if np.isfinite(motion).all() else None
