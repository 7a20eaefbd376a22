"""Masks that hold two things, or more than what moved, on cards before a wall."""

from __future__ import annotations

import numpy as np

from helpers.flat_scenes import Card, draw, object_of
from objectflow import geometry
from objectflow.alignment.frame_pair import FramePair
from objectflow.methods.postprocess.settings import PostprocessSettings
from objectflow.methods.postprocess.split_objects import split_objects
from objectflow.typing import BoolMask, Float64Array

DEFAULTS = PostprocessSettings()


def iou(one: BoolMask, other: BoolMask) -> float:
    return float((one & other).sum() / (one | other).sum())


def assert_close(found: Float64Array, true: Float64Array, center: Float64Array, metres: float = 0.003) -> None:
    assert np.linalg.norm(geometry.transform(found, center) - geometry.transform(true, center)) < metres


def test_two_touching_things_with_two_motions_are_two_objects() -> None:
    """Their mask has the motion of the left one; the right one stands still."""
    left, right = Card(1, 40, 40, 40, 40, 0.75), Card(2, 80, 40, 40, 40, 0.9)
    before = Card(1, 30, 40, 40, 40, 0.75)
    prev, curr = draw(right, before), draw(right, left)
    labels = (left.mask | right.mask).astype(np.int32)
    obj = object_of(1, labels > 0, curr, left.motion(10))
    out, found = split_objects(FramePair(prev, curr), labels, (obj,), DEFAULTS)
    assert len(found) == 2
    for card, motion, moving in ((left, left.motion(10), True), (right, np.eye(4), False)):
        best = max(found, key=lambda one: iou(out == one.id, card.mask))
        assert iou(out == best.id, card.mask) > 0.9
        assert_close(best.prev_T_curr, motion, best.center)
        assert best.moving is moving
        assert best.score == obj.score


def test_two_things_that_move_apart_are_two_objects() -> None:
    left, right = Card(1, 40, 40, 40, 40, 0.75), Card(2, 80, 40, 40, 40, 0.9)
    prev = draw(Card(2, 80, 48, 40, 40, 0.9), Card(1, 34, 40, 40, 40, 0.75))
    curr = draw(right, left)
    labels = (left.mask | right.mask).astype(np.int32)
    obj = object_of(1, labels > 0, curr, left.motion(6))
    out, found = split_objects(FramePair(prev, curr), labels, (obj,), DEFAULTS)
    assert len(found) == 2
    for card, motion in ((left, left.motion(6)), (right, right.motion(0, -8))):
        best = max(found, key=lambda one: iou(out == one.id, card.mask))
        assert_close(best.prev_T_curr, motion, best.center)
        assert best.moving


def test_one_body_behind_an_obstacle_stays_one() -> None:
    card, bar = Card(1, 40, 40, 70, 40, 0.85), Card(2, 70, 20, 10, 80, 0.65)
    prev, curr = draw(Card(1, 46, 40, 70, 40, 0.85), bar), draw(card, bar)
    mask = card.mask & ~bar.mask
    labels, obj = mask.astype(np.int32), object_of(1, mask, curr, card.motion(-6))
    out, found = split_objects(FramePair(prev, curr), labels, (obj,), DEFAULTS)
    np.testing.assert_array_equal(out, labels)
    assert len(found) == 1
    np.testing.assert_array_equal(found[0].prev_T_curr, obj.prev_T_curr)


def test_a_ghost_in_the_mask_does_not_decide_the_motion() -> None:
    """Old depth persists where the card was, and colour shows the wall: the card itself gives the motion."""
    before, card = Card(1, 30, 40, 40, 40, 0.8), Card(1, 80, 40, 40, 40, 0.8)
    prev, curr = draw(before), draw(card)
    curr.depth[before.mask] = before.depth
    labels = (before.mask | card.mask).astype(np.int32)
    obj = object_of(1, labels > 0, curr, card.motion(25))
    _, found = split_objects(FramePair(prev, curr), labels, (obj,), DEFAULTS)
    assert len(found) == 1
    assert_close(found[0].prev_T_curr, card.motion(50), np.array([0.1, 0.0, 0.8]))
    assert found[0].moving
