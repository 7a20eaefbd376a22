"""The second look: what it adds, what it leaves alone, and where the network is asked to look."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
import pytest

from helpers.flat_scenes import CAMERA, Card, draw, object_of
from objectflow import geometry
from objectflow.alignment.frame_pair import FramePair
from objectflow.errors import SettingsError
from objectflow.methods.labels import Objects
from objectflow.methods.postprocess.look_settings import LookWindowSettings, SecondLookSettings
from objectflow.methods.postprocess.look_windows import Remainder, Window, find_remainder, find_windows
from objectflow.methods.postprocess.pair_likelihood import PairLikelihood
from objectflow.methods.postprocess.pipeline import check_steps, postprocess
from objectflow.methods.postprocess.second_look import Look, second_look
from objectflow.methods.postprocess.settings import PostprocessSettings
from objectflow.typing import BoolMask, Float64Array, LabelImage

DEFAULTS = PostprocessSettings()
CARD = Card(1, 60, 40, 24, 20, 0.85)
CURR = draw(CARD)
NOTHING = np.zeros((CAMERA.height, CAMERA.width), np.int32)


def moved(columns: int, rows: int = 0) -> FramePair:
    """The pair in which the card moved by so many pixels to the right and down."""
    return FramePair(draw(dataclasses.replace(CARD, left=CARD.left - columns, top=CARD.top - rows)), CURR)


def sees(mask: BoolMask, motion: Float64Array, windows: list[Window] | None = None) -> Look:
    """A network that finds one object in every window that shows any of it."""

    def look(pair: FramePair, asked: Sequence[Window]) -> list[tuple[LabelImage, Objects]]:
        if windows is not None:
            windows.extend(asked)
        found = []
        for window in asked:
            labels = mask[window.slices].astype(np.int32)
            objects = (object_of(1, mask, CURR, motion, score=0.2),) if labels.any() else ()
            found.append((labels, objects))
        return found

    return look


def largest_error(found: Float64Array, true: Float64Array) -> float:
    """Metres between the ends of the card's points under two motions."""
    points = geometry.back_project(CURR.depth, CURR.camera)[CARD.mask]
    return float(np.linalg.norm(geometry.transform(found, points) - geometry.transform(true, points), axis=1).max())


@pytest.mark.parametrize(("columns", "rows"), [(3, 0), (-2, 3), (6, -2)])
def test_an_object_that_the_first_look_missed_is_added_with_its_motion(columns: int, rows: int) -> None:
    windows: list[Window] = []
    pair = moved(columns, rows)
    labels, (found,) = second_look(pair, NOTHING, (), DEFAULTS, look=sees(CARD.mask, np.eye(4), windows))
    assert windows
    assert np.array_equal(labels == found.id, CARD.mask)
    assert found.moving
    assert found.pixels == CARD.mask.sum()
    assert largest_error(found.prev_T_curr, CARD.motion(columns, rows)) < 0.002


def test_nothing_is_looked_at_where_nothing_changed() -> None:
    windows: list[Window] = []
    labels, objects = second_look(
        FramePair(CURR, CURR), NOTHING, (), DEFAULTS, look=sees(CARD.mask, CARD.motion(3), windows)
    )
    assert not windows
    assert labels is NOTHING
    assert objects == ()


def test_a_found_motion_explains_the_change() -> None:
    """The card is a known mover: no pixel of it is left to look at."""
    windows: list[Window] = []
    obj = object_of(1, CARD.mask, CURR, CARD.motion(3))
    second_look(moved(3), CARD.mask.astype(np.int32), (obj,), DEFAULTS, look=sees(CARD.mask, np.eye(4), windows))
    assert not windows


def test_what_stood_still_is_not_added() -> None:
    """The network claims that a part of the wall beside the card moved."""
    wall = np.zeros_like(CARD.mask)
    wall[40:60, 90:115] = True
    motion = geometry.make_transform(np.eye(3), [0.02, 0, 0])
    labels, objects = second_look(moved(3), NOTHING, (), DEFAULTS, look=sees(wall, motion))
    assert labels is NOTHING
    assert objects == ()


def test_an_object_that_the_window_cuts_is_not_added() -> None:
    """A window of half the frame cannot show a card that is wider."""
    wide = Card(1, 30, 40, 100, 12, 0.85)
    curr = draw(wide)
    prev = draw(dataclasses.replace(wide, left=wide.left - 3))
    look = sees(wide.mask, wide.motion(3))
    assert second_look(FramePair(prev, curr), NOTHING, (), DEFAULTS, look=look)[1] == ()


def test_a_contradicted_object_keeps_the_motion_of_the_network() -> None:
    """The previous frame shows the card nowhere, so no registration explains it; standing still cannot either."""
    prev = draw(dataclasses.replace(CARD, seed=2, depth=0.95))
    settings = dataclasses.replace(DEFAULTS, second_look=SecondLookSettings(contradicted_cost=1.0, max_hidden=1))
    _, (found,) = second_look(FramePair(prev, CURR), NOTHING, (), settings, look=sees(CARD.mask, CARD.motion(7)))
    assert np.array_equal(found.prev_T_curr, CARD.motion(7))
    strict = dataclasses.replace(DEFAULTS, second_look=SecondLookSettings(contradicted_cost=10, max_cost=0.1))
    assert second_look(FramePair(prev, CURR), NOTHING, (), strict, look=sees(CARD.mask, CARD.motion(7)))[1] == ()


def test_a_known_mover_is_not_added_again() -> None:
    """Its motion is wrong, so its pixels are unexplained; the steps before have decided on it."""
    obj = object_of(1, CARD.mask, CURR, CARD.motion(12))
    labels = CARD.mask.astype(np.int32)
    found, objects = second_look(moved(3), labels, (obj,), DEFAULTS, look=sees(CARD.mask, CARD.motion(3)))
    assert found is labels
    assert objects == (obj,)


def test_an_object_takes_its_pixels_from_the_one_it_was_merged_with() -> None:
    """The first look gave the card and a part of the wall one mask, which is at rest."""
    both = CARD.mask.copy()
    both[40:60, 84:120] = True
    resting = dataclasses.replace(object_of(1, both, CURR, np.eye(4)), moving=False)
    labels, objects = second_look(
        moved(3), both.astype(np.int32), (resting,), DEFAULTS, look=sees(CARD.mask, CARD.motion(2))
    )
    rest, mover = objects
    assert not rest.moving
    assert mover.moving
    assert np.array_equal(labels == mover.id, CARD.mask)
    assert np.array_equal(labels == rest.id, both & ~CARD.mask)


def test_windows_surround_the_regions_and_lie_in_the_frame() -> None:
    pair = moved(3)
    likelihood = PairLikelihood.of(pair, DEFAULTS.likelihood)
    remainder = find_remainder(likelihood, NOTHING, ())
    size = (2 * CAMERA.height, 2 * CAMERA.width)
    (window,) = find_windows(likelihood, NOTHING, (), remainder, size, LookWindowSettings())
    assert (window.width, window.height) == (CAMERA.width, CAMERA.height)
    rows, columns = np.nonzero(CARD.mask)
    assert window.x <= 2 * columns.min() < 2 * columns.max() < window.x + window.width
    assert window.y <= 2 * rows.min() < 2 * rows.max() < window.y + window.height
    assert find_windows(likelihood, NOTHING, (), remainder, size, LookWindowSettings(max_windows=0)) == []
    # A corner's window is moved into the frame.
    corner = Card(1, 0, 0, 24, 20, 0.85)
    pair = FramePair(draw(dataclasses.replace(corner, left=3)), draw(corner))
    likelihood = PairLikelihood.of(pair, DEFAULTS.likelihood)
    remainder = find_remainder(likelihood, NOTHING, ())
    windows = find_windows(likelihood, NOTHING, (), remainder, size, LookWindowSettings())
    assert (windows[0].x, windows[0].y) == (0, 0)


def test_regions_must_stand_out_of_what_noise_costs() -> None:
    """The frame costs 0.2 everywhere and a region 1.5, which is above 0.7 + 3 x 0.2 and below 0.7 + 6 x 0.2."""
    likelihood = PairLikelihood.of(moved(3), DEFAULTS.likelihood)
    cost = np.full(NOTHING.shape, 0.2, np.float32)
    cost[40:70, 60:100] = 1.5
    remainder = Remainder(cost, np.zeros(NOTHING.shape, np.bool_))
    size = (CAMERA.height, CAMERA.width)
    for ratio, count in ((0.0, 1), (3.0, 1), (6.0, 0)):
        settings = LookWindowSettings(min_cost=0.7, noise_ratio=ratio)
        assert len(find_windows(likelihood, NOTHING, (), remainder, size, settings)) == count


def test_the_steps_look_again_and_judge_what_was_added() -> None:
    pair = moved(4)
    labels, (found,) = postprocess(pair, NOTHING, (), DEFAULTS, look=sees(CARD.mask, np.eye(4)))
    assert found.moving
    assert found.score > 0.5
    assert largest_error(found.prev_T_curr, CARD.motion(4)) < 0.002
    assert ((labels == found.id) & CARD.mask).sum() > 0.95 * CARD.mask.sum()
    # Without a network there is no second look: the search alone may find the card.
    steps = ("second_look",)
    assert postprocess(pair, NOTHING, (), dataclasses.replace(DEFAULTS, steps=steps))[1] == ()


def test_an_unknown_following_step_is_refused() -> None:
    settings = dataclasses.replace(DEFAULTS, second_look=SecondLookSettings(then=("merge", "polish")))
    with pytest.raises(SettingsError, match=r"second_look\.then has no step 'polish': choose among refine"):
        check_steps(settings)
