"""Motions by features: a textured object is found again where no other search reaches."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
import pytest

from objectflow import geometry
from objectflow.alignment.frame_pair import FramePair
from objectflow.frame import RgbdFrame
from objectflow.geometry.camera import Camera
from objectflow.methods.postprocess.feature_motions import feature_motion, match_features
from objectflow.methods.postprocess.motion_search import search_motions
from objectflow.methods.postprocess.pair_likelihood import PairLikelihood
from objectflow.methods.postprocess.search_settings import FeatureMotionSettings
from objectflow.methods.postprocess.settings import PostprocessSettings
from objectflow.motion import ObjectMotion
from objectflow.typing import BoolMask, Float64Array, UInt8Array

DEFAULTS = PostprocessSettings()
CAMERA = Camera(640, 480, 600.0, 600.0, 319.5, 239.5)
DEPTH, SIDE = 1.0, 110
PLACES = (90, 180), (440, 230)
"""Column and row of the card's corner in both frames: it moves by 58 cm and turns by half a turn."""
MOVED = geometry.make_transform(
    np.diag([-1.0, -1.0, 1.0]),
    [(PLACES[0][k] + PLACES[1][k] + SIDE - 1 - c) / 600.0 for k, c in ((0, 639), (1, 479))] + [0.0],
)
"""`prev_T_curr`: the pixel p goes to the sum of both corners plus the side, minus p."""


def noise(seed: int, height: int, width: int, low: int, high: int) -> UInt8Array:
    coarse = np.random.default_rng(seed).integers(low, high, (height // 6 + 1, width // 6 + 1, 3)).astype(np.uint8)
    return np.asarray(cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC))


def frames() -> tuple[RgbdFrame, RgbdFrame, BoolMask]:
    """A card before a textured wall in two places, upside down in the first; and its mask in the second."""
    card, out = noise(1, SIDE, SIDE, 20, 235), []
    for image, (left, top) in ((card[::-1, ::-1], PLACES[0]), (card, PLACES[1])):
        color, depth = noise(2, 480, 640, 90, 150), np.full((480, 640), 1.3, np.float32)
        area = slice(top, top + SIDE), slice(left, left + SIDE)
        color[area], depth[area] = image, DEPTH
        out.append(RgbdFrame(color, depth, CAMERA))
    return out[0], out[1], out[1].depth == DEPTH


def error(motion: Float64Array) -> float:
    """Metres at the card's corners."""
    ends = (np.array([*PLACES[1]]), np.array([*PLACES[1]]) + SIDE - 1)
    points = geometry.back_project_pixels(np.array(ends, np.float32), np.full(2, DEPTH, np.float32), CAMERA)
    return float(np.linalg.norm(geometry.transform(motion, points) - geometry.transform(MOVED, points), axis=1).max())


def test_features_find_a_card_again_that_moved_far_and_turned_upside_down() -> None:
    prev, curr, mask = frames()
    pair = FramePair(prev, curr)
    likelihood = PairLikelihood.of(pair, DEFAULTS.likelihood)
    settings = FeatureMotionSettings()
    matches = match_features(pair, settings)
    assert match_features(pair, settings) is matches
    small = likelihood.mask(likelihood.downscale(mask.astype(np.int32)), 1)
    found = feature_motion(matches, pair, likelihood, small, settings)
    assert found is not None
    assert error(found) < 0.002
    many = FeatureMotionSettings(min_inliers=100_000)
    assert feature_motion(matches, pair, likelihood, small, many) is None


@pytest.mark.parametrize(("min_inliers", "is_found"), [(8, True), (100_000, False)])
def test_the_search_takes_the_motion_of_the_features(min_inliers: int, is_found: bool) -> None:
    """The start is 58 cm off, and the search by sampling alone ends elsewhere."""
    prev, curr, mask = frames()
    settings = dataclasses.replace(
        DEFAULTS,
        motion_search=dataclasses.replace(
            DEFAULTS.motion_search, features=FeatureMotionSettings(min_inliers=min_inliers)
        ),
    )
    start = ObjectMotion(
        1, int(mask.sum()), 0.8, True, np.array([0.3, 0.1, DEPTH]), geometry.make_transform(np.eye(3), [0.02, 0, 0])
    )
    _, (obj,) = search_motions(FramePair(prev, curr), mask.astype(np.int32), (start,), settings)
    assert obj.moving
    assert (error(obj.prev_T_curr) < 0.003) is is_found
