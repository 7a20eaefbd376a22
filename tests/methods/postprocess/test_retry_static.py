"""Another registration of objects at rest: small motions are found; what stood still or changed otherwise rests."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from helpers.flat_scenes import Card, draw, object_of
from objectflow import geometry
from objectflow.alignment.frame_pair import FramePair
from objectflow.frame import RgbdFrame
from objectflow.methods.postprocess.pipeline import postprocess
from objectflow.methods.postprocess.retry_static import retry_static
from objectflow.methods.postprocess.settings import PostprocessSettings, RetryStaticSettings
from objectflow.motion import ObjectMotion
from objectflow.typing import Float64Array

DEFAULTS = PostprocessSettings()
CARD = Card(1, 60, 40, 44, 40, 0.85)
CURR = draw(CARD)
LABELS = CARD.mask.astype(np.int32)


def moved(columns: int, rows: int = 0) -> RgbdFrame:
    """The frame before the card moved by so many pixels to the right and down."""
    return draw(dataclasses.replace(CARD, left=CARD.left - columns, top=CARD.top - rows))


def at_rest(score: float = 0.2) -> ObjectMotion:
    return dataclasses.replace(object_of(1, CARD.mask, CURR, np.eye(4), score), moving=False)


def largest_error(found: Float64Array, true: Float64Array) -> float:
    """Metres between the ends of the card's points under two motions."""
    points = geometry.back_project(CURR.depth, CURR.camera)[CARD.mask]
    return float(np.linalg.norm(geometry.transform(found, points) - geometry.transform(true, points), axis=1).max())


@pytest.mark.parametrize(("columns", "rows"), [(2, 0), (0, -3), (-4, 2)])
def test_a_small_motion_is_found_from_rest(columns: int, rows: int) -> None:
    labels, (found,) = retry_static(FramePair(moved(columns, rows), CURR), LABELS, (at_rest(),), DEFAULTS)
    assert labels is LABELS
    assert found.moving
    assert largest_error(found.prev_T_curr, CARD.motion(columns, rows)) < 0.002


def test_an_object_that_stood_still_is_not_registered() -> None:
    obj = at_rest()
    assert retry_static(FramePair(CURR, CURR), LABELS, (obj,), DEFAULTS)[1][0] is obj


def test_an_object_that_no_motion_explains_rests() -> None:
    """Its place shows another surface before: nothing in the previous frame has its colours."""
    prev = draw(dataclasses.replace(CARD, seed=2))
    obj = at_rest()
    assert retry_static(FramePair(prev, CURR), LABELS, (obj,), DEFAULTS)[1][0] is obj


def test_a_moving_object_keeps_its_motion() -> None:
    obj = object_of(1, CARD.mask, CURR, np.eye(4))
    assert retry_static(FramePair(moved(3), CURR), LABELS, (obj,), DEFAULTS)[1][0] is obj


def test_a_stricter_gain_leaves_the_object_at_rest() -> None:
    obj, strict = at_rest(), dataclasses.replace(DEFAULTS, retry_static=RetryStaticSettings(min_gain=10))
    assert retry_static(FramePair(moved(3), CURR), LABELS, (obj,), strict)[1][0] is obj


def test_the_steps_find_an_object_whose_network_motion_is_none() -> None:
    pair = FramePair(moved(3), CURR)
    start = object_of(1, CARD.mask, CURR, np.eye(4), score=0.1)
    _, (found,) = postprocess(pair, LABELS, (start,), DEFAULTS)
    assert found.moving
    assert found.score > 0.5
    assert largest_error(found.prev_T_curr, CARD.motion(3)) < 0.002
