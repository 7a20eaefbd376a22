"""Masks at rest that moving objects found by the search take over, on cards before a wall."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from helpers.flat_scenes import Card, draw, object_of
from objectflow import geometry
from objectflow.alignment.frame_pair import FramePair
from objectflow.frame import RgbdFrame
from objectflow.methods.postprocess.missed_objects import recover_missed_objects
from objectflow.methods.postprocess.pipeline import postprocess
from objectflow.methods.postprocess.resting_masks import take_resting_masks
from objectflow.methods.postprocess.settings import MissedObjectSettings, PostprocessSettings
from objectflow.typing import BoolMask

DEFAULTS = PostprocessSettings()


def plain_bar(left: int) -> tuple[RgbdFrame, BoolMask]:
    """A bar of one colour, 80 by 24 pixels, whose right end alone is textured."""
    bar, end = Card(1, left, 48, 80, 24, 0.85), Card(2, left + 56, 48, 24, 24, 0.85)
    frame = draw(bar, end)
    frame.color[bar.mask & ~end.mask] = (200, 40, 40)
    return frame, bar.mask


def at_rest(mask: BoolMask, score: float = 0.2) -> tuple[np.ndarray, tuple]:
    obj = object_of(1, mask, CURR, np.eye(4), score)
    return mask.astype(np.int32), (dataclasses.replace(obj, moving=False),)


(PREV, _), (CURR, BAR) = plain_bar(30), plain_bar(40)
MOTION = Card(1, 40, 48, 80, 24, 0.85).motion(10)
END = BAR & (np.arange(160)[None] >= 96)


def test_the_whole_mask_follows_the_motion_of_its_part() -> None:
    proposed, resting = at_rest(BAR)
    labels = np.where(END, np.int32(2), np.int32(0))
    # The part's motion is off by 3 mm towards the camera's right, and by a degree.
    off = geometry.se3_exp(np.array([0.003, 0, 0, 0, 0, np.radians(1)])) @ MOTION
    found = (object_of(2, END, CURR, off),)
    out, (obj,) = take_resting_masks(FramePair(PREV, CURR), labels, found, proposed, resting, DEFAULTS)
    np.testing.assert_array_equal(out == 2, BAR)
    points = geometry.back_project(CURR.depth, CURR.camera)[BAR]
    error = geometry.transform(obj.prev_T_curr, points) - geometry.transform(MOTION, points)
    assert np.linalg.norm(error, axis=1).max() < 0.002


def test_a_textured_thing_at_rest_in_the_mask_keeps_it() -> None:
    still, mover = Card(3, 20, 40, 40, 40, 0.9), Card(4, 60, 40, 40, 40, 0.85)
    prev, curr = draw(still, Card(4, 68, 40, 40, 40, 0.85)), draw(still, mover)
    proposed = (still.mask | mover.mask).astype(np.int32)
    resting = (dataclasses.replace(object_of(1, proposed > 0, curr, np.eye(4)), moving=False),)
    labels = np.where(mover.mask, np.int32(2), np.int32(0))
    found = (object_of(2, mover.mask, curr, mover.motion(-8)),)
    out, same = take_resting_masks(FramePair(prev, curr), labels, found, proposed, resting, DEFAULTS)
    np.testing.assert_array_equal(out, labels)
    np.testing.assert_array_equal(same[0].prev_T_curr, found[0].prev_T_curr)


@pytest.mark.parametrize(("share", "taken"), [(0.2, True), (0.5, False)])
def test_the_found_object_must_lie_in_the_mask(share: float, taken: bool) -> None:
    """About a third of the found object lies in the mask at rest."""
    proposed, resting = at_rest(BAR & (np.arange(160)[None] < 103))
    labels = np.where(END, np.int32(2), np.int32(0))
    settings = dataclasses.replace(DEFAULTS, missed_objects=MissedObjectSettings(min_inside=share))
    found = (object_of(2, END, CURR, MOTION),)
    out, _ = take_resting_masks(FramePair(PREV, CURR), labels, found, proposed, resting, settings)
    assert ((out == 2) & BAR).sum() == (BAR.sum() if taken else END.sum())


@pytest.mark.parametrize("score", [0.2, 0.8])
def test_a_body_that_the_network_had_at_rest_is_found_whole(score: float) -> None:
    labels, objects = at_rest(BAR, score)
    out, found = recover_missed_objects(FramePair(PREV, CURR), labels, objects, DEFAULTS)
    (obj,) = (one for one in found if one.moving)
    assert ((out == obj.id) & BAR).sum() > 0.97 * BAR.sum()


def test_masks_at_rest_that_nothing_takes_stay_until_they_are_dropped() -> None:
    still = Card(5, 20, 80, 30, 30, 0.9)
    prev, curr = draw(still), draw(still)
    labels, sure = still.mask.astype(np.int32), object_of(1, still.mask, curr, np.eye(4), 0.2)
    objects = (dataclasses.replace(sure, moving=False),)
    out, found = recover_missed_objects(FramePair(prev, curr), labels, objects, DEFAULTS)
    np.testing.assert_array_equal(out, labels)
    assert found == objects
    assert postprocess(FramePair(prev, curr), labels, objects, DEFAULTS)[1] == ()
