"""+Refine: wrong motions become right ones, right ones stay, and none explains the depth worse than before."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

import analytic
from objectflow import geometry
from objectflow.alignment import registration
from objectflow.alignment.frame_pair import FramePair
from objectflow.alignment.refine_objects import depth_cost, refine_objects, refine_one
from objectflow.motion import ObjectMotion


def true_objects(pair: analytic.AnalyticPair) -> tuple[ObjectMotion, ...]:
    return tuple(
        ObjectMotion(k, int((pair.labels == k).sum()), 0.5, True, pair.centers[k], pair.prev_T_curr[k])
        for k in sorted(pair.prev_T_curr)
        if (pair.labels == k).any()
    )


def disturbed(obj: ObjectMotion, metres: float, degrees: float, rng: np.random.Generator) -> ObjectMotion:
    """Off by this much at the centre, and turned about it."""
    shift, turn = rng.normal(size=(2, 3))
    shift *= metres / np.linalg.norm(shift)
    turn *= np.radians(degrees) / np.linalg.norm(turn)
    R = geometry.so3_exp(turn) @ obj.prev_T_curr[:3, :3]
    there = geometry.transform(obj.prev_T_curr, obj.center) + shift
    return dataclasses.replace(obj, prev_T_curr=geometry.make_transform(R, there - R @ obj.center))


def error(pair: analytic.AnalyticPair, obj: ObjectMotion) -> float:
    """Mean distance in metres of the object's points from where they were."""
    mask = (pair.labels == obj.id) & pair.curr.valid
    points = geometry.back_project(pair.curr.depth, pair.curr.camera)[mask].astype(np.float64)
    off = geometry.transform(obj.prev_T_curr, points) - points - pair.scene_flow[mask]
    return float(np.linalg.norm(off, axis=1).mean())


@pytest.mark.parametrize(("metres", "degrees", "share"), [(0.01, 5, 0.2), (0.04, 20, 0.4)])
def test_wrong_motions_are_put_right(metres: float, degrees: float, share: float) -> None:
    """From 4 cm off most would end beside the truth without the matches' start."""
    rng = np.random.default_rng(0)
    before, after = [], []
    for seed in range(51, 54):
        pair = analytic.make_scene(seed, objects=(3, 6), depth_noise=0.0015)
        start = tuple(disturbed(obj, metres, degrees, rng) for obj in true_objects(pair))
        for old, new in zip(start, refine_objects(FramePair(pair.prev, pair.curr), pair.labels, start), strict=True):
            assert (new.id, new.pixels, new.score) == (old.id, old.pixels, old.score)
            np.testing.assert_array_equal(new.center, old.center)
            before.append(error(pair, old))
            after.append(error(pair, new))
    assert len(after) >= 10
    assert np.median(after) < 0.001
    assert np.mean(after) < share * np.mean(before)


def test_wide_frames_are_refined_too() -> None:
    pair = analytic.make_scene(51, objects=(2, 2), width=800, height=600)
    start = tuple(disturbed(obj, 0.01, 5, np.random.default_rng(1)) for obj in true_objects(pair))
    for new in refine_objects(FramePair(pair.prev, pair.curr), pair.labels, start):
        assert error(pair, new) < 0.001


def test_no_object_explains_the_depth_worse_than_before() -> None:
    rng = np.random.default_rng(2)
    pair = analytic.make_scene(60, objects=(5, 5), depth_noise=0.002)
    target = registration.RegistrationTarget(pair.prev)
    for metres, degrees in ((0.0, 1e-9), (0.03, 30), (0.3, 90)):
        start = tuple(disturbed(obj, metres, degrees, rng) for obj in true_objects(pair))
        for old, new in zip(start, refine_objects(FramePair(pair.prev, pair.curr), pair.labels, start), strict=True):
            source = registration.make_source(pair.curr, pair.labels == old.id, limit=2000)
            costs = [
                depth_cost(registration.evaluate_registration(target, source, obj.prev_T_curr), source)
                for obj in (old, new)
            ]
            assert costs[1] <= costs[0]


def test_a_motion_does_not_go_far_to_lie_on_a_part_of_something_else() -> None:
    """The object has gone; only a strip of the previous frame is as near as it was, half as wide as the object."""
    height, width = 120, 160
    curr_depth = np.full((height, width), 1.0, np.float32)
    curr_depth[40:80, 60:100] = 0.6
    prev_depth = np.full((height, width), 1.0, np.float32)
    prev_depth[40:80, 85:105] = 0.57
    frame = analytic.make_scene(1, width=width, height=height).prev
    mask = np.zeros((height, width), bool)
    mask[40:80, 60:100] = True
    source = registration.make_source(dataclasses.replace(frame, depth=curr_depth), mask)
    target = registration.RegistrationTarget(dataclasses.replace(frame, depth=prev_depth))
    lured = geometry.make_transform(np.eye(3), [0.03, 0.0, -0.03])
    assert depth_cost(registration.evaluate_registration(target, source, lured), source) < depth_cost(
        registration.evaluate_registration(target, source, np.eye(4)), source
    )
    np.testing.assert_array_equal(refine_one(target, source, [np.eye(4), lured]), np.eye(4))


def test_depth_cost_is_the_truncated_mean_square() -> None:
    """Against a sum over points: a wall at 1 m, seen again 2 mm behind for half of them and far off for the rest."""
    wall = np.full((60, 80), 1.0, np.float32)
    frame = dataclasses.replace(analytic.make_scene(1, width=80, height=60).prev, depth=wall)
    moved = wall.copy()
    moved[:, :40] += 0.002
    moved[:, 40:] -= 0.3
    target = registration.RegistrationTarget(dataclasses.replace(frame, depth=moved))
    left = np.zeros((60, 80), bool)
    left[5:55, 5:35] = True
    right = left[:, ::-1]
    limit = (3 * (0.0012 + 0.0019 * 0.6**2)) ** 2
    for mask, expected in ((left, 0.002**2), (right, limit), (left | right, (0.002**2 + limit) / 2)):
        source = registration.make_source(frame, mask)
        found = registration.evaluate_registration(target, source, np.eye(4))
        assert depth_cost(found, source) == pytest.approx(expected, rel=1e-3)


def test_nothing_to_refine_stays_as_it_is() -> None:
    pair = analytic.make_scene(1, width=80, height=60)
    assert refine_objects(FramePair(pair.prev, pair.curr), pair.labels, ()) == ()
    obj = dataclasses.replace(true_objects(pair)[0], id=40)
    (kept,) = refine_objects(FramePair(pair.prev, pair.curr), pair.labels, (obj,))
    np.testing.assert_array_equal(kept.prev_T_curr, obj.prev_T_curr)
    nothing = registration.make_source(pair.curr, np.zeros((60, 80), bool))
    np.testing.assert_array_equal(
        refine_one(registration.RegistrationTarget(pair.prev), nothing, [np.eye(4)]), np.eye(4)
    )


def test_what_stands_still_after_all_is_said_to() -> None:
    pair = analytic.make_scene(52, objects=(2, 2), moving_share=0.0)
    start = tuple(disturbed(obj, 0.01, 5, np.random.default_rng(3)) for obj in true_objects(pair))
    assert [obj.moving for obj in refine_objects(FramePair(pair.prev, pair.curr), pair.labels, start)] == [
        False,
        False,
    ]
