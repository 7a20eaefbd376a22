"""Pieces of one body are joined, bodies of their own are not: known masks and motions, cut in two."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

import analytic
from objectflow import geometry
from objectflow.frame import RgbdFrame
from objectflow.geometry.camera import Camera
from objectflow.methods.postprocess.merge_fragments import merge_fragments
from objectflow.methods.postprocess.pair_likelihood import DEPTH_STEP, PairLikelihood
from objectflow.motion import ObjectMotion
from objectflow.typing import Float64Array, LabelImage


def true_objects(pair: analytic.AnalyticPair) -> tuple[ObjectMotion, ...]:
    return tuple(
        ObjectMotion(k, int((pair.labels == k).sum()), 0.5, k in pair.moving, pair.centers[k], pair.prev_T_curr[k])
        for k in sorted(pair.prev_T_curr)
        if (pair.labels == k).any()
    )


def cut(pair: analytic.AnalyticPair, number: int, share: float = 0.4) -> tuple[LabelImage, tuple[ObjectMotion, ...]]:
    """An object's left part becomes an object of its own, with a motion that is off by a millimetre."""
    mask = pair.labels == number
    columns = np.nonzero(mask.any(axis=0))[0]
    left = mask & (np.arange(mask.shape[1]) < np.quantile(columns, share))
    new = max(pair.prev_T_curr) + 1
    labels = np.where(left, np.int32(new), pair.labels)
    objects = true_objects(pair)
    (whole,) = (obj for obj in objects if obj.id == number)
    near = geometry.make_transform(np.eye(3), [0.001, 0.0, 0.0]) @ whole.prev_T_curr
    rest = tuple(dataclasses.replace(obj, pixels=int((labels == obj.id).sum())) for obj in objects)
    return labels, (*rest, dataclasses.replace(whole, id=new, pixels=int(left.sum()), score=0.7, prev_T_curr=near))


def test_an_object_cut_in_two_is_whole_again() -> None:
    joined = 0
    for seed in range(51, 57):
        pair = analytic.make_scene(seed, objects=(3, 5), depth_noise=0.0015)
        number = max(pair.moving, key=lambda k: int((pair.labels == k).sum()))
        labels, objects = cut(pair, number)
        out, found = merge_fragments(PairLikelihood(pair.prev, pair.curr, labels), labels, objects)
        if len(found) == len(objects):
            continue
        joined += 1
        # The very partition of before, under other numbers.
        both = np.unique(np.stack([pair.labels.ravel(), out.ravel()]), axis=1)
        assert both.shape[1] == len(np.unique(pair.labels)) == len(np.unique(out))
        assert [obj.pixels for obj in found] == [int((out == obj.id).sum()) for obj in found]
        assert max(obj.score for obj in found) == 0.7
    assert joined >= 5


def test_bodies_of_their_own_stay_apart() -> None:
    for seed in range(51, 57):
        pair = analytic.make_scene(seed, objects=(5, 8), depth_noise=0.0015)
        objects = true_objects(pair)
        labels, found = merge_fragments(PairLikelihood(pair.prev, pair.curr, pair.labels), pair.labels, objects)
        np.testing.assert_array_equal(labels, pair.labels)
        assert found == objects


CAMERA = Camera(width=80, height=60, fx=80.0, fy=80.0, cx=40.0, cy=30.0)
SHIFT = geometry.make_transform(np.eye(3), [0.0, 0.0, 0.1])


def two_halves(gap: float = 0.0) -> tuple[RgbdFrame, RgbdFrame, LabelImage]:
    """A plate before a wall that came nearer by 10 cm, in two halves, the right one `gap` metres behind the left."""
    prev, curr = np.full((60, 80), 1.5, np.float32), np.full((60, 80), 1.5, np.float32)
    labels = np.zeros((60, 80), np.int32)
    labels[20:40, 20:35], labels[20:40, 35:60] = 1, 2
    prev[labels == 1], curr[labels == 1] = 0.9, 0.8
    prev[labels == 2], curr[labels == 2] = 0.9 + gap, 0.8 + gap
    color = np.full((60, 80, 3), 120, np.uint8)
    return RgbdFrame(color, prev, CAMERA), RgbdFrame(color, curr, CAMERA), labels


def half(number: int, pixels: int, motion: Float64Array = SHIFT, *, moving: bool = True) -> ObjectMotion:
    return ObjectMotion(number, pixels, 0.5, moving, np.array([0.0, 0.0, 0.8]), motion)


@pytest.mark.parametrize(
    ("gap", "motion", "moving", "count"),
    [
        (0.0, SHIFT, True, 1),
        (2 * DEPTH_STEP, SHIFT, True, 2),  # no surface goes on from one to the other
        (0.0, SHIFT, False, 2),  # one stands still
        (
            0.0,
            geometry.make_transform(np.eye(3), [0.0, 0.0, 0.3]),
            True,
            1,
        ),  # one motion is wrong, the other fits both
    ],
)
def test_what_it_takes_to_be_joined(gap: float, motion: Float64Array, moving: bool, count: int) -> None:
    prev, curr, labels = two_halves(gap)
    objects = (half(1, 300, motion, moving=moving), half(2, 500))
    out, found = merge_fragments(PairLikelihood(prev, curr, labels), labels, objects)
    assert len(found) == count == len(np.unique(out)) - 1
    if count == 1:
        np.testing.assert_array_equal(out > 0, labels > 0)
        np.testing.assert_array_equal(found[0].prev_T_curr, SHIFT)
        assert found[0].pixels == 800


def test_motions_that_explain_nothing_join_nothing() -> None:
    prev, curr, labels = two_halves()
    wrong = geometry.make_transform(np.eye(3), [0.0, 0.0, -0.3])
    objects = (half(1, 300, wrong), half(2, 500, wrong))
    assert len(merge_fragments(PairLikelihood(prev, curr, labels), labels, objects)[1]) == 2


def test_three_pieces_become_one() -> None:
    prev, curr, labels = two_halves()
    labels[20:40, 50:60] = 3
    objects = (half(1, 300), half(2, 300), half(3, 200))
    out, found = merge_fragments(PairLikelihood(prev, curr, labels), labels, objects)
    assert [obj.pixels for obj in found] == [800]
    np.testing.assert_array_equal(out > 0, labels > 0)


def test_contact_is_the_share_of_the_border_where_the_surface_goes_on() -> None:
    """Half of the rows step by 5 cm."""
    _, curr, labels = two_halves()
    depth = curr.depth.copy()
    depth[30:40, 35:60] += 0.05
    likelihood = PairLikelihood(curr, dataclasses.replace(curr, depth=depth), labels)
    assert likelihood.contact(labels == 1) == pytest.approx({2: 0.5})
    assert likelihood.contact(labels == 2) == pytest.approx({1: 0.5})


def test_nothing_to_join() -> None:
    prev, curr, labels = two_halves()
    out, found = merge_fragments(PairLikelihood(prev, curr, labels), labels, ())
    assert found == ()
    np.testing.assert_array_equal(out, labels)
