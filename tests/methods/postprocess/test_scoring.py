"""Scores of moving objects: high for true motions and low for wrong ones, on scenes with known motions."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
import pytest

import analytic
from helpers.flat_scenes import Card, draw, object_of
from objectflow import geometry
from objectflow.alignment.frame_pair import FramePair
from objectflow.alignment.likelihood import motion_confidence
from objectflow.frame import RgbdFrame
from objectflow.geometry.camera import Camera
from objectflow.methods.postprocess.scoring import UNSEEN, confirmed_score, set_confidence, two_way_confidence
from objectflow.methods.postprocess.settings import PostprocessSettings, RivalSettings, StaticTestSettings
from objectflow.motion import ObjectMotion

DEFAULTS = PostprocessSettings()


def test_motion_confidence_in_numbers() -> None:
    cost = np.array([0.0, 0.0, 0.0, 5.0], np.float32)
    assert motion_confidence(cost, np.full(4, 1.0, np.float32)) == pytest.approx(0.75 * (1 - np.exp(-2)), abs=1e-4)
    assert motion_confidence(cost, np.zeros(4, np.float32)) == 0
    assert motion_confidence(cost, np.full(4, -1.0, np.float32)) == 0  # worse than its rival
    assert motion_confidence(cost[:3], np.full(3, 50.0, np.float32)) == 1


@pytest.mark.parametrize("seed", [51, 53, 56])
def test_true_motions_score_high_and_wrong_ones_low(seed: int) -> None:
    scene = analytic.make_scene(seed, objects=(3, 5), depth_noise=0.0015, width=320, height=240)
    pair = FramePair(scene.prev, scene.curr)
    for k, motion in scene.prev_T_curr.items():
        obj = ObjectMotion(k, int((scene.labels == k).sum()), 0.5, True, scene.centers[k], motion)
        if obj.pixels < 500 or np.linalg.norm(obj.translation) < 0.02:
            continue
        wrong = geometry.make_transform(np.eye(3), [0.0, 0.0, -0.04]) @ motion  # violates free space
        labels, (right,) = set_confidence(pair, scene.labels, (obj,), DEFAULTS)
        _, (off,) = set_confidence(pair, scene.labels, (dataclasses.replace(obj, prev_T_curr=wrong),), DEFAULTS)
        assert labels is scene.labels
        assert right.score > 0.7
        assert off.score < 0.1
        assert (right.id, right.pixels, right.moving) == (obj.id, obj.pixels, obj.moving)
        assert right.rigid


def test_two_way_confidence_in_numbers() -> None:
    cost = np.array([0.0, 0.0, 0.0, 5.0, UNSEEN], np.float32)
    before, gain = np.array([0.0, 6.0], np.float32), np.full(5, 1.0, np.float32)
    settings = StaticTestSettings(two_way_exponent=0.5)
    expected = 0.8 * np.sqrt(0.75 * 0.5) * (1 - np.exp(-2))
    assert two_way_confidence(cost, before, gain, settings) == pytest.approx(expected, abs=1e-4)
    assert two_way_confidence(cost, before, -gain, settings) == 0
    assert two_way_confidence(cost, before[:0], gain, settings) == 0
    assert two_way_confidence(cost[4:], before, gain[4:], settings) == 0


def test_confirmed_score_in_numbers() -> None:
    settings = RivalSettings(unconfirmed_score=0.4, rate=4.0)
    assert confirmed_score(0.9, 0.5, 0.8, settings) == pytest.approx(0.4 + 0.5 * 0.8 * (1 - np.exp(-2)), abs=1e-4)
    assert confirmed_score(0.9, np.inf, 1.0, settings) == 0.9
    assert confirmed_score(0.9, 0.0, 1.0, settings) == 0.4
    assert confirmed_score(0.9, -3.0, 1.0, settings) == 0.4  # a rival explains the object better
    assert confirmed_score(0.9, np.inf, 0.0, settings) == 0.4
    assert confirmed_score(0.3, 0.0, 0.0, settings) == 0.3


def test_what_lies_between_the_pixels_in_the_previous_frame_must_fit_as_well() -> None:
    """A fence moved by 10 pixels: its posts fit the previous frame, whether or not a board was between them."""
    card = Card(1, 50, 40, 40, 30, 0.8)
    between = card.mask & (np.arange(160)[None] % 2 == 1)
    curr = draw(card)
    curr.depth[between] = 1.0
    posts = card.mask & ~between
    obj = object_of(1, posts, curr, card.motion(10))
    scores = []
    for depth in (0.0, 0.6):  # unknown, or a board before the fence
        prev = draw(Card(1, 40, 40, 40, 30, 0.8))
        prev.depth[np.roll(between, -10, axis=1)] = depth
        scores.append(set_confidence(FramePair(prev, curr), posts.astype(np.int32), (obj,), DEFAULTS)[1][0].score)
    assert scores[0] > 0.95
    assert scores[1] == pytest.approx(0.5**DEFAULTS.static_test.two_way_exponent, abs=0.05)


def test_static_objects_keep_their_scores() -> None:
    scene = analytic.make_scene(51)
    static = ObjectMotion(1, 10, 0.4, False, np.zeros(3), np.eye(4))
    assert set_confidence(FramePair(scene.prev, scene.curr), scene.labels, (static,), DEFAULTS)[1] == (static,)


def test_a_moving_object_without_a_pixel_of_depth_scores_0() -> None:
    """Neither frame confirms its motion, whatever the network's probability."""
    scene = analytic.make_scene(51)
    mask = scene.labels == 1
    assert mask.any()
    curr = dataclasses.replace(scene.curr, depth=np.where(mask, 0, scene.curr.depth).astype(np.float32))
    nowhere, without_depth = (ObjectMotion(k, 10, 0.9, True, np.zeros(3), scene.prev_T_curr[1]) for k in (999, 1))
    _, found = set_confidence(FramePair(scene.prev, curr), scene.labels, (nowhere, without_depth), DEFAULTS)
    assert [obj.score for obj in found] == [0.0, 0.0]
    assert all(obj.moving for obj in found)


def test_the_score_falls_with_the_share_that_the_previous_frame_does_not_show() -> None:
    """A wall that slides along itself: the farther it comes from beyond the border, the less confirms its motion."""
    rng = np.random.default_rng(0)
    strip = cv2.GaussianBlur(rng.integers(0, 255, (60, 200, 3), dtype=np.uint8), (0, 0), 1.2)
    camera = Camera(width=80, height=60, fx=80.0, fy=80.0, cx=39.5, cy=29.5)
    wall = np.full((60, 80), 1.0, np.float32)
    shown, scores = [], []
    for shift in (8, 40, 64):
        prev, curr = (RgbdFrame(strip[:, at : at + 80].copy(), wall, camera) for at in (100, 100 - shift))
        motion = geometry.make_transform(np.eye(3), [-shift / 80, 0.0, 0.0])
        obj = ObjectMotion(1, wall.size, 0.9, True, np.array([0.0, 0.0, 1.0]), motion)
        labels = np.ones((60, 80), np.int32)
        (found,) = set_confidence(FramePair(prev, curr), labels, (obj,), DEFAULTS)[1]
        shown.append(1 - shift / 80)
        scores.append(found.score)
    assert 0.75 * shown[0] < scores[0] <= shown[0]
    assert 0.5 * shown[1] < scores[1] <= shown[1]
    assert scores[2] <= min(shown[2], DEFAULTS.static_test.unseen_score)


def test_two_things_in_one_mask_are_not_one_rigid_object() -> None:
    scene = analytic.make_scene(51, objects=(3, 5), depth_noise=0.0015, width=320, height=240)
    pair = FramePair(scene.prev, scene.curr)
    first, second = sorted(scene.prev_T_curr, key=lambda k: -int((scene.labels == k).sum()))[:2]
    both = np.isin(scene.labels, (first, second))
    labels = np.where(both, first, 0).astype(np.int32)
    assert 0.25 < (scene.labels[both] == second).mean() < 0.5
    obj = ObjectMotion(first, int(both.sum()), 0.5, True, scene.centers[first], scene.prev_T_curr[first])
    (found,) = set_confidence(pair, labels, (obj,), DEFAULTS)[1]
    assert not found.rigid
    (alone,) = set_confidence(pair, np.where(scene.labels == first, first, 0).astype(np.int32), (obj,), DEFAULTS)[1]
    assert alone.rigid
    assert found.score < alone.score
