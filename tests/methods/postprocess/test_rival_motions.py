"""Rivals of a motion on discs: any turn explains a plain disc, one turn explains a painted one."""

from __future__ import annotations

import dataclasses
from functools import cache

import cv2
import numpy as np

from helpers.flat_scenes import CAMERA, WALL, object_of, texture
from objectflow import geometry
from objectflow.alignment.frame_pair import FramePair
from objectflow.frame import RgbdFrame
from objectflow.methods.postprocess.pair_likelihood import PairLikelihood
from objectflow.methods.postprocess.rival_motions import rival_loss
from objectflow.methods.postprocess.scoring import set_confidence
from objectflow.methods.postprocess.search_likelihood import SearchLikelihood
from objectflow.methods.postprocess.settings import PostprocessSettings
from objectflow.typing import BoolMask, Float64Array

DEFAULTS = PostprocessSettings()
DEPTH, RADIUS, SHIFT = 0.8, 18, 12
"""Of the disc: depth in metres, radius in pixels, and displacement to the right in pixels."""
METRES = DEPTH / CAMERA.fx
"""Metres per pixel on the disc."""


def disc_mask(column: int, radius: int = RADIUS) -> BoolMask:
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    return np.asarray((u - column) ** 2 + (v - 60) ** 2 <= radius**2)


def disc_at(column: int, degrees: float, *, painted: bool, radius: int = RADIUS) -> RgbdFrame:
    """A disc that faces the camera, turned in its plane, before a textured wall."""
    size = 2 * radius + 1
    paint = texture(5, size, size) if painted else np.full((size, size, 3), (200, 60, 40), np.uint8)
    turned = cv2.warpAffine(
        paint, cv2.getRotationMatrix2D((radius, radius), degrees, 1.0), (size, size), borderMode=cv2.BORDER_REFLECT
    )
    color = texture(99, CAMERA.height, CAMERA.width, 90, 150).copy()
    depth = np.full(color.shape[:2], WALL, np.float32)
    mask = disc_mask(column, radius)
    patch = color[60 - radius : 61 + radius, column - radius : column + radius + 1]
    inside = mask[60 - radius : 61 + radius, column - radius : column + radius + 1]
    patch[inside] = turned[inside]
    depth[mask] = DEPTH
    return RgbdFrame(color, depth, CAMERA)


@cache
def disc_pair(*, painted: bool) -> FramePair:
    """A disc that moves to the right without a turn."""
    return FramePair(disc_at(80, 0, painted=painted), disc_at(80 + SHIFT, 0, painted=painted))


def motion_with_turn(degrees: float) -> Float64Array:
    """The disc's motion to the right, and a turn in its plane about its centre."""
    center = np.array([(80 + SHIFT - CAMERA.cx) * METRES, (60 - CAMERA.cy) * METRES, DEPTH])
    R = geometry.so3_exp(np.radians(degrees) * np.array([0.0, 0.0, 1.0]))
    return geometry.make_transform(R, center - [SHIFT * METRES, 0.0, 0.0] - R @ center)


def loss(
    pair: FramePair, degrees: float, settings: PostprocessSettings = DEFAULTS, mask: BoolMask | None = None
) -> float:
    likelihood = PairLikelihood.of(pair, settings.likelihood)
    mask = disc_mask(80 + SHIFT) if mask is None else mask
    return rival_loss(SearchLikelihood.of(pair, settings), likelihood, mask, motion_with_turn(degrees), settings)


def test_any_turn_explains_a_plain_disc_as_well() -> None:
    assert abs(loss(disc_pair(painted=False), 0.0)) < 0.05
    assert abs(loss(disc_pair(painted=False), 60.0)) < 0.05


def test_no_rival_explains_a_painted_disc_as_well_as_its_motion() -> None:
    assert loss(disc_pair(painted=True), 0.0) > 0.5


def test_a_rival_explains_a_painted_disc_better_than_a_wrong_turn() -> None:
    assert loss(disc_pair(painted=True), 25.0) < -0.5


def test_motions_within_the_distance_are_no_rivals() -> None:
    """Turns of at most 180 degrees carry the points of the disc by less than its diameter."""
    rivals = dataclasses.replace(DEFAULTS.rivals, min_distance=2.1 * RADIUS * METRES, shift_ratios=())
    assert loss(disc_pair(painted=False), 0.0, dataclasses.replace(DEFAULTS, rivals=rivals)) == np.inf


def test_a_few_pixels_surpass_no_rival() -> None:
    few = np.zeros((CAMERA.height, CAMERA.width), bool)
    few[60, 90:95] = True
    assert loss(disc_pair(painted=True), 0.0, mask=few) == 0.0


def test_the_score_is_unsure_of_the_turn_of_a_plain_disc() -> None:
    scores = []
    for painted in (False, True):
        pair = disc_pair(painted=painted)
        mask = disc_mask(80 + SHIFT)
        obj = object_of(1, mask, pair.curr.frame, motion_with_turn(0.0))
        scores.append(set_confidence(pair, mask.astype(np.int32), (obj,), DEFAULTS)[1][0].score)
    unsure = DEFAULTS.rivals.unconfirmed_score
    assert unsure <= scores[0] < unsure + 0.15
    assert scores[1] > 0.85
