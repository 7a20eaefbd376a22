"""The static test: moving objects keep their motions and static ones are reset, on known scenes."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

import analytic
from helpers.flat_scenes import WALL, Card, draw, object_of
from helpers.truths import true_objects
from objectflow import geometry
from objectflow.alignment.frame_pair import FramePair
from objectflow.alignment.likelihood import LikelihoodSettings
from objectflow.frame import RgbdFrame
from objectflow.geometry.camera import Camera
from objectflow.methods.postprocess.pair_likelihood import PairLikelihood
from objectflow.methods.postprocess.settings import PostprocessSettings, StaticTestSettings
from objectflow.methods.postprocess.static_test import MotionEvidence, find_evidence, reject_static, rest_hidden
from objectflow.methods.postprocess.uncovered import RestingCosts
from objectflow.motion import ObjectMotion
from objectflow.typing import BoolMask, Float64Array

DEFAULTS = PostprocessSettings()
LIKELIHOOD = LikelihoodSettings()


def shifted(obj: ObjectMotion, shift: tuple[float, float, float]) -> ObjectMotion:
    """The object with a motion that is off by this much, in metres."""
    return dataclasses.replace(obj, prev_T_curr=geometry.make_transform(np.eye(3), list(shift)) @ obj.prev_T_curr)


@pytest.mark.parametrize(("width", "seeds"), [(320, range(51, 55)), (800, range(51, 52))], ids=["320", "800"])
def test_moving_objects_keep_their_motions(width: int, seeds: range) -> None:
    for seed in seeds:
        scene = analytic.make_scene(seed, objects=(3, 6), depth_noise=0.0015, width=width, height=width * 3 // 4)
        start = true_objects(scene, score=0.3, all_moving=True)
        labels, found = reject_static(FramePair(scene.prev, scene.curr), scene.labels, start, DEFAULTS)
        assert labels is scene.labels
        assert len(found) == len(start)
        for true, obj in zip(start, found, strict=True):
            moved = np.linalg.norm(true.translation) > 0.02
            assert obj.moving >= moved
            if obj.moving:
                np.testing.assert_array_equal(obj.prev_T_curr, true.prev_T_curr)
            assert (obj.id, obj.pixels, obj.score) == (true.id, true.pixels, true.score)


def test_static_objects_get_the_identity() -> None:
    for seed in range(51, 54):
        scene = analytic.make_scene(seed, objects=(3, 6), depth_noise=0.0015, moving_share=0.0)
        start = tuple(shifted(obj, (0.02, 0.01, 0.0)) for obj in true_objects(scene, score=0.9, all_moving=True))
        for obj in reject_static(FramePair(scene.prev, scene.curr), scene.labels, start, DEFAULTS)[1]:
            assert not obj.moving
            np.testing.assert_array_equal(obj.prev_T_curr, np.eye(4))


def test_a_small_motion_stays_and_counts_as_static() -> None:
    scene = analytic.make_scene(51, objects=(2, 2), moving_share=0.0)
    pair = FramePair(scene.prev, scene.curr)
    start = tuple(shifted(obj, (0.002, 0.0, 0.0)) for obj in true_objects(scene, score=0.3, all_moving=True))
    for old, new in zip(start, reject_static(pair, scene.labels, start, DEFAULTS)[1], strict=True):
        assert not new.moving
        np.testing.assert_array_equal(new.prev_T_curr, old.prev_T_curr)
    # With a lower displacement the evidence decides, and there is none.
    test = StaticTestSettings(static_displacement=0.001)
    settings = dataclasses.replace(DEFAULTS, static_test=test)
    for obj in reject_static(pair, scene.labels, start, settings)[1]:
        assert not obj.moving
        np.testing.assert_array_equal(obj.prev_T_curr, np.eye(4))


CAMERA = Camera(width=80, height=60, fx=80.0, fy=80.0, cx=40.0, cy=30.0)
PATCH = np.zeros((60, 80), bool)
PATCH[20:40, 30:50] = True
LABELS = PATCH.astype(np.int32)


def frame(depth: float, patch: float | None = None) -> RgbdFrame:
    """A grey wall with a patch at another depth."""
    image = np.full((60, 80), depth, np.float32)
    if patch is not None:
        image[PATCH] = patch
    return RgbdFrame(color=np.full((60, 80, 3), 120, np.uint8), depth=image, camera=CAMERA)


def patch_object(motion: Float64Array, score: float) -> ObjectMotion:
    return ObjectMotion(1, int(PATCH.sum()), score, True, np.array([0.0, 0.0, 1.0]), motion)


FAR = geometry.make_transform(np.eye(3), [0.0, 0.0, 0.3])
"""A motion without support in these frames: from behind the wall."""


@pytest.mark.parametrize("score", [0.1, 0.9])
def test_an_object_that_would_violate_free_space_moved_even_if_its_motion_fits_badly(score: float) -> None:
    """A patch in front of the wall, where the previous frame shows only the wall."""
    _, (obj,) = reject_static(FramePair(frame(1.0), frame(1.0, 0.8)), LABELS, (patch_object(FAR, score),), DEFAULTS)
    assert obj.moving
    np.testing.assert_array_equal(obj.prev_T_curr, FAR)


@pytest.mark.parametrize(
    ("score", "confidence", "moving"), [(0.3, 0.6, False), (0.9, 0.6, True), (0.3, 0.2, True), (0.9, 0.95, False)]
)
def test_a_hidden_object_moved_only_if_the_network_is_confident(score: float, confidence: float, moving: bool) -> None:
    """A piece of wall that was hidden: it may have been there or not."""
    settings = dataclasses.replace(DEFAULTS, static_test=StaticTestSettings(network_confidence=confidence))
    _, (obj,) = reject_static(FramePair(frame(1.0, 0.7), frame(1.0)), LABELS, (patch_object(FAR, score),), settings)
    assert obj.moving is moving
    assert np.array_equal(obj.prev_T_curr, FAR if moving else np.eye(4))


def test_what_may_have_been_hidden_rests_where_no_motion_explains_it_better() -> None:
    """A piece of wall of which something hid the left quarter, however confident the network is."""
    prev = frame(1.0)
    prev.depth[20:40, 30:35] = 0.7
    hidden, back = FramePair(prev, frame(1.0)), geometry.make_transform(np.eye(3), [0.0, 0.0, 0.2])
    _, (obj,) = rest_hidden(hidden, LABELS, (patch_object(FAR, 0.95),), DEFAULTS)
    assert (obj.moving, obj.score) == (False, 0.95)
    np.testing.assert_array_equal(obj.prev_T_curr, np.eye(4))
    # In front of the wall, it would violate free space, so it moved; and another motion explains it.
    for pair, motion in (
        (FramePair(frame(1.0), frame(1.0, 0.8)), FAR),
        (FramePair(frame(1.0), frame(1.0, 0.8)), back),
    ):
        start = patch_object(motion, 0.1)
        assert rest_hidden(pair, LABELS, (start,), DEFAULTS)[1] == (start,)
    resting = dataclasses.replace(patch_object(np.eye(4), 0.95), moving=False)
    assert rest_hidden(hidden, LABELS, (resting,), DEFAULTS)[1] == (resting,)
    strict = dataclasses.replace(DEFAULTS, static_test=StaticTestSettings(hidden_cost=0.2))
    assert rest_hidden(hidden, LABELS, (patch_object(FAR, 0.95),), strict)[1][0].moving


def test_the_evidence_is_the_mean_difference_of_the_costs() -> None:
    """Half of the mask in front of the wall, half on it: a motion by 20 cm explains only the first half."""
    mask = PATCH.copy()
    mask[:, 50:70] = PATCH[:, 30:50]
    likelihood = PairLikelihood(FramePair(frame(1.0, 1.0), frame(1.0, 0.8)), LIKELIHOOD)
    back = geometry.make_transform(np.eye(3), [0.0, 0.0, 0.2])
    labels, obj = mask.astype(np.int32), patch_object(back, 0.5)
    resting = RestingCosts(likelihood, labels, (obj,), DEFAULTS.static_test)
    found = find_evidence(likelihood, labels, obj, resting, DEFAULTS)
    assert found is not None
    # Static: a free-space violation and a perfect fit. Moving: a perfect fit, and 20 cm behind the wall: hidden.
    assert found.gain == pytest.approx((LIKELIHOOD.free_space_violation - LIKELIHOOD.hidden) / 2, abs=0.05)
    assert found.static_inliers == pytest.approx(0.5, abs=0.01)
    assert found.violations == pytest.approx(0.5, abs=0.01)


@pytest.mark.parametrize(
    ("gain", "static_inliers", "violations", "score", "moved"),
    [
        (0.5, 1.0, 0.0, 0.1, True),  # the motion explains the object better
        (0.1, 0.5, 0.5, 0.9, False),  # standing still explains a part of it
        (-2.0, 0.1, 0.5, 0.1, True),  # it cannot have stood still
        (-2.0, 0.1, 0.0, 0.2, False),  # it may have been hidden
        (-2.0, 0.1, 0.0, 0.4, True),  # the same, with a confident network
    ],
)
def test_gain_decides_first(gain: float, static_inliers: float, violations: float, score: float, moved: bool) -> None:
    evidence = MotionEvidence(gain=gain, static_inliers=static_inliers, violations=violations)
    assert evidence.moved(score, StaticTestSettings()) is moved


@pytest.mark.parametrize("score", [0.1, 0.95])
def test_objects_without_depth_are_static(score: float) -> None:
    """No evidence is not taken for motion, however confident the network is."""
    curr = frame(1.0)
    empty = dataclasses.replace(curr, depth=np.where(PATCH, 0, curr.depth).astype(np.float32))
    pair = FramePair(curr, empty)
    _, (obj,) = reject_static(pair, LABELS, (patch_object(FAR, score),), DEFAULTS)
    assert not obj.moving
    np.testing.assert_array_equal(obj.prev_T_curr, np.eye(4))
    likelihood = PairLikelihood(pair, LIKELIHOOD)
    resting = RestingCosts(likelihood, LABELS, (obj,), DEFAULTS.static_test)
    assert find_evidence(likelihood, LABELS, obj, resting, DEFAULTS) is None
    assert reject_static(pair, LABELS, (), DEFAULTS)[1] == ()


WALL_CARD = Card(5, 70, 50, 24, 24, WALL)
"""A thing as flat as a printed sheet, on the wall."""
HAND = Card(6, 96, 40, 40, 44, 0.85)
"""A larger mover to the right of it."""


def shadow_scene(*cards: Card, dark: BoolMask | None = None) -> RgbdFrame:
    """Cards before the wall, parts of which lie in the shade."""
    frame = draw(*cards)
    if dark is not None:
        frame.color[dark] = (0.6 * frame.color[dark]).astype(np.uint8)
    return frame


def rests_beside_the_hand(prev: RgbdFrame, curr: RgbdFrame, motion: Float64Array) -> bool:
    """Whether the pixels of `WALL_CARD`, with this motion, count as static beside a hand that moved to the left."""
    labels = np.where(HAND.mask, 2, np.where(WALL_CARD.mask, 1, 0)).astype(np.int32)
    start = (object_of(1, WALL_CARD.mask, curr, motion), object_of(2, HAND.mask, curr, HAND.motion(-8)))
    thing, hand = reject_static(FramePair(prev, curr), labels, start, DEFAULTS)[1]
    assert hand.moving
    return not thing.moving


def test_a_flat_thing_that_slides_beside_a_mover_is_no_shadow() -> None:
    before = dataclasses.replace(WALL_CARD, top=WALL_CARD.top - 6), dataclasses.replace(HAND, left=HAND.left + 8)
    prev, curr = shadow_scene(*before), shadow_scene(WALL_CARD, HAND)
    assert not rests_beside_the_hand(prev, curr, WALL_CARD.motion(0, 6))


def test_a_shadow_beside_a_mover_rests() -> None:
    prev = shadow_scene(dataclasses.replace(HAND, left=HAND.left + 8))
    curr = shadow_scene(HAND, dark=WALL_CARD.mask)
    assert rests_beside_the_hand(prev, curr, WALL_CARD.motion(0, 6))


def test_a_reflection_that_follows_its_mover_rests() -> None:
    before = dataclasses.replace(WALL_CARD, left=WALL_CARD.left + 7), dataclasses.replace(HAND, left=HAND.left + 8)
    prev, curr = shadow_scene(*before), shadow_scene(WALL_CARD, HAND)
    assert rests_beside_the_hand(prev, curr, WALL_CARD.motion(-7))
