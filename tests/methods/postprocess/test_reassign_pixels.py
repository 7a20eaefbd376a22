"""Masks that end early are completed and those that hold too much are reduced, on cards before a wall."""

from __future__ import annotations

import numpy as np
import pytest

from helpers.flat_scenes import Card, draw, object_of
from objectflow.alignment.frame_pair import FramePair
from objectflow.methods.postprocess.reassign_pixels import reassign_pixels
from objectflow.methods.postprocess.settings import PostprocessSettings
from objectflow.typing import BoolMask

DEFAULTS = PostprocessSettings()
CARD, BEFORE = Card(1, 60, 30, 50, 60, 0.8), Card(1, 48, 30, 50, 60, 0.8)


def iou(one: BoolMask, other: BoolMask) -> float:
    return float((one & other).sum() / (one | other).sum())


def early() -> BoolMask:
    """The upper four fifths of the card."""
    mask = CARD.mask.copy()
    mask[78:] = False
    return mask


def late() -> BoolMask:
    """The card with 5 pixels of wall around it."""
    return Card(1, 55, 25, 60, 70, 0.8).mask


@pytest.mark.parametrize("mask", [early(), late()], ids=["ends early", "holds too much"])
def test_masks_become_those_of_their_object(mask: BoolMask) -> None:
    prev, curr = draw(BEFORE), draw(CARD)
    obj = object_of(1, mask, curr, CARD.motion(12))
    out, (found,) = reassign_pixels(FramePair(prev, curr), mask.astype(np.int32), (obj,), DEFAULTS)
    assert iou(mask, CARD.mask) < 0.81
    assert iou(out > 0, CARD.mask) > 0.9
    np.testing.assert_array_equal(found.prev_T_curr, obj.prev_T_curr)
    assert found.pixels == (out > 0).sum()


def test_a_mover_does_not_grow_over_a_neighbour_that_moves_otherwise() -> None:
    """No object has the pixels of the neighbour, which cannot have stood still either."""
    near, near_before = Card(2, 110, 30, 30, 60, 0.8), Card(2, 110, 20, 30, 60, 0.8)
    prev, curr = draw(BEFORE, near_before), draw(CARD, near)
    obj = object_of(1, CARD.mask, curr, CARD.motion(12))
    out, _ = reassign_pixels(FramePair(prev, curr), CARD.mask.astype(np.int32), (obj,), DEFAULTS)
    assert (out[near.mask] > 0).mean() < 0.1
    assert iou(out > 0, CARD.mask) > 0.9


def test_objects_at_rest_and_without_explanation_keep_their_pixels() -> None:
    prev, curr = draw(BEFORE), draw(CARD)
    wrong = object_of(1, early(), curr, CARD.motion(0, 15))
    still = Card(3, 10, 30, 20, 20, 0.8).mask
    labels = early().astype(np.int32) + 2 * still.astype(np.int32)
    rest = object_of(2, still, curr, np.eye(4))
    objects = (wrong, type(rest)(2, rest.pixels, 0.8, False, rest.center, np.eye(4)))
    out, found = reassign_pixels(FramePair(prev, curr), labels, objects, DEFAULTS)
    for number in (1, 2):
        assert iou(out == number, labels == number) > 0.9
    assert [obj.moving for obj in found] == [True, False]


def test_thin_parts_are_not_cut_off() -> None:
    """A handle has a short border where it leaves its object, so cutting it off is cheap."""
    handle, handle_before = Card(1, 110, 58, 34, 3, 0.8), Card(1, 98, 58, 34, 3, 0.8)
    prev, curr = draw(BEFORE, handle_before), draw(CARD, handle)
    mask = CARD.mask | handle.mask
    obj = object_of(1, mask, curr, CARD.motion(12))
    out, _ = reassign_pixels(FramePair(prev, curr), mask.astype(np.int32), (obj,), DEFAULTS)
    assert (out[handle.mask] > 0).mean() > 0.9
    assert iou(out > 0, mask) > 0.95


def test_an_object_keeps_the_part_that_was_hidden() -> None:
    """Its motion does not explain that part, but standing still does so even less."""
    prev, curr = draw(BEFORE, Card(2, 48, 30, 50, 20, 0.5)), draw(CARD)
    obj = object_of(1, CARD.mask, curr, CARD.motion(12))
    out, _ = reassign_pixels(FramePair(prev, curr), CARD.mask.astype(np.int32), (obj,), DEFAULTS)
    assert iou(out > 0, CARD.mask) > 0.95
