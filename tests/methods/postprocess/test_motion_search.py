"""The search for motions: its cost by closed forms, places and motions by scenes whose truth is known."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import analytic
from objectflow import geometry
from objectflow.frame import RgbdFrame
from objectflow.geometry.camera import Camera
from objectflow.methods.postprocess.color_proposals import propose_positions
from objectflow.methods.postprocess.motion_search import PoseHypotheses, search_motions, suppress_duplicates
from objectflow.methods.postprocess.pair_likelihood import PairLikelihood
from objectflow.methods.postprocess.search_likelihood import (
    COST_FREE_SPACE_VIOLATION,
    COST_OUT_OF_VIEW,
    SearchLikelihood,
)
from objectflow.motion import ObjectMotion

CAMERA = Camera(160, 120, 120.0, 120.0, 79.5, 59.5)


def wall(depth: float = 1.0, grey: int = 128) -> RgbdFrame:
    return RgbdFrame(np.full((120, 160, 3), grey, np.uint8), np.full((120, 160), depth, np.float32), CAMERA)


def cost_of(prev: RgbdFrame, shift: tuple[float, float, float], grey: int = 128) -> float:
    """Of a point in the middle of a grey wall at a metre, shifted."""
    frames = SearchLikelihood(prev, wall(grey=grey))
    point, look = np.array([[0.0, 0.0, 1.0]], np.float32), frames.curr_appearance[60:61, 80]
    (cost,) = frames(np.eye(3)[None], np.array([shift]), point, look, reach=0.02, shade=10.0)
    return float(cost)


@pytest.mark.parametrize(
    ("shift", "expected"),
    [
        ((0, 0, 0), 0.0),
        ((0.1, 0, 0), 0.0),  # along the wall
        ((0, 0, 0.02), 0.5),  # reach
        ((0, 0, -0.04), 2.0),  # 0.5 * 2^2, before the wall
        ((0, 0, -0.061), COST_FREE_SPACE_VIOLATION),
        ((0, 0, 0.041), COST_OUT_OF_VIEW),  # behind it
        ((2.0, 0, 0), COST_OUT_OF_VIEW),  # out of the image
        ((0, 0, -2.0), COST_FREE_SPACE_VIOLATION),  # behind the camera, and so before the wall
    ],
)
def test_cost_of_depth(shift: tuple[float, float, float], expected: float) -> None:
    assert cost_of(wall(), shift) == pytest.approx(expected, abs=1e-4)


def test_cost_of_colour() -> None:
    assert cost_of(wall(grey=0), (0, 0, 0), grey=255) == pytest.approx(2.0, abs=1e-5)  # and no more
    # OpenCV's 8-bit lightness of 128 and 160 is 137 and 168; a quarter of that counts.
    assert cost_of(wall(grey=128), (0, 0, 0), grey=160) == pytest.approx(0.5 * ((168 - 137) / 4 / 10) ** 2, rel=0.1)


def test_cost_where_nothing_was_measured() -> None:
    depth = np.full((120, 160), 1.0, np.float32)
    depth[:, 60:100] = 0
    assert cost_of(dataclasses.replace(wall(), depth=depth), (0, 0, 0)) == COST_OUT_OF_VIEW


def test_the_place_of_a_red_patch() -> None:
    frames = []
    for column in (30, 90):
        frame = wall(grey=90)
        color, depth = frame.color.copy(), frame.depth.copy()
        color[50:70, column : column + 24] = (200, 30, 30)
        depth[50:70, column : column + 24] = 0.8
        frames.append(RgbdFrame(color, depth, CAMERA))
    both = SearchLikelihood(*frames)
    points = geometry.back_project(frames[1].depth, CAMERA)[50:70, 90:114].reshape(-1, 3)
    place = propose_positions(both, points, both.curr_appearance[50:70, 90:114].reshape(-1, 3))[0]
    true = points.mean(axis=0) - [60 / 120 * 0.8, 0, 0]
    assert np.linalg.norm(place - true) < 0.02


def true_objects(pair: analytic.AnalyticPair) -> tuple[ObjectMotion, ...]:
    return tuple(
        ObjectMotion(k, int((pair.labels == k).sum()), 0.5, k in pair.moving, pair.centers[k], pair.prev_T_curr[k])
        for k in sorted(pair.prev_T_curr)
        if (pair.labels == k).any()
    )


def disturbed(obj: ObjectMotion, turn: float, shift: tuple[float, float, float]) -> ObjectMotion:
    """With a motion that is off by a turn about the object's own place (degrees) and a shift (metres)."""
    place = geometry.transform(obj.prev_T_curr, obj.center)
    R = Rotation.from_rotvec(np.radians(turn) * np.array([0.6, 0.0, 0.8])).as_matrix()
    wrong = geometry.make_transform(R, place - R @ place + shift)
    return dataclasses.replace(obj, prev_T_curr=wrong @ obj.prev_T_curr)


def error(pair: analytic.AnalyticPair, obj: ObjectMotion) -> float:
    """Metres: mean over the object's pixels, against the exact flow."""
    mask = pair.labels == obj.id
    points = geometry.back_project(pair.curr.depth, pair.curr.camera)[mask].astype(np.float64)
    return float(
        np.linalg.norm(geometry.transform(obj.prev_T_curr, points) - points - pair.scene_flow[mask], axis=1).mean()
    )


def test_motions_are_found_again() -> None:
    """Off by 5 cm and 30 degrees, nearly every object that the previous frame shows comes back to within 1 cm."""
    before, after = [], []
    for seed in range(61, 67):
        pair = analytic.make_scene(seed, objects=(3, 5), depth_noise=0.0015, max_angle_deg=30)
        start = tuple(disturbed(obj, 30.0, (0.04, -0.02, 0.02)) if obj.moving else obj for obj in true_objects(pair))
        found = search_motions(pair.prev, pair.curr, PairLikelihood(pair.prev, pair.curr, pair.labels), start)
        assert [(one.id, one.score, one.pixels) for one in found] == [(one.id, one.score, one.pixels) for one in start]
        for old, new in zip(start, found, strict=True):
            mask = pair.labels == old.id
            if pair.kinds[old.id] == "box" and old.moving and pair.visible[mask].mean() > 0.7:
                before.append(error(pair, old))
                after.append(error(pair, new))
            if not old.moving:
                assert new is old
    assert len(after) >= 5
    assert min(before) > 0.03
    assert np.mean(np.array(after) < 0.01) >= 0.75


def test_good_motions_stay() -> None:
    pair = analytic.make_scene(62, objects=(3, 5), depth_noise=0.0015)
    start = true_objects(pair)
    found = search_motions(pair.prev, pair.curr, PairLikelihood(pair.prev, pair.curr, pair.labels), start)
    for old, new in zip(start, found, strict=True):
        if pair.visible[pair.labels == old.id].mean() > 0.9:
            assert new is old


def test_no_motion_is_made_up_for_what_was_not_there() -> None:
    """An object that the previous frame does not show at all keeps the motion that it came with."""
    pair = analytic.make_scene(63, objects=(1, 1), motion=(0.05, 0.1))
    (obj,) = true_objects(pair)
    empty = np.asarray(pair.prev.depth).copy()
    color = np.asarray(pair.prev.color).copy()
    gone = pair.prev_labels == obj.id
    empty[gone] = empty[~gone].max()
    color[gone] = 0
    prev = dataclasses.replace(pair.prev, depth=empty, color=color)
    start = (disturbed(obj, 20.0, (0.05, 0.0, 0.0)),)
    assert search_motions(prev, pair.curr, PairLikelihood(prev, pair.curr, pair.labels), start) == start


def test_the_same_frames_give_the_same_motions() -> None:
    pair = analytic.make_scene(61, objects=(3, 3), depth_noise=0.0015)
    start = tuple(disturbed(obj, 30.0, (0.04, 0.0, 0.0)) for obj in true_objects(pair))
    once, again = (
        search_motions(pair.prev, pair.curr, PairLikelihood(pair.prev, pair.curr, pair.labels), start)
        for _ in range(2)
    )
    for a, b in zip(once, again, strict=True):
        np.testing.assert_array_equal(a.prev_T_curr, b.prev_T_curr)


def test_guesses_that_are_kept_lie_apart() -> None:
    rng = np.random.default_rng(0)
    guesses = PoseHypotheses(Rotation.random(400, random_state=1).as_matrix(), rng.uniform(-0.05, 0.05, (400, 3)))
    cost = rng.uniform(size=400)
    kept = suppress_duplicates(guesses, cost, 10, np.radians(20), 0.02)
    assert kept[0] == cost.argmin()
    assert list(cost[kept]) == sorted(cost[kept])
    some = guesses.take(kept)
    for i in range(len(kept)):
        for j in range(i):
            turn = Rotation.from_matrix(some.rotations[i] @ some.rotations[j].T).magnitude()
            assert turn > np.radians(20) or np.linalg.norm(some.places[i] - some.places[j]) > 0.02


def test_nothing_to_search_for() -> None:
    pair = analytic.make_scene(61, objects=(1, 1))
    likelihood = PairLikelihood(pair.prev, pair.curr, pair.labels)
    assert search_motions(pair.prev, pair.curr, likelihood, ()) == ()
    blind = dataclasses.replace(true_objects(pair)[0], id=99)
    assert search_motions(pair.prev, pair.curr, likelihood, (blind,)) == (blind,)
