"""Scores of moving objects: high for true motions and low for wrong ones, on scenes with known motions."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

import analytic
from objectflow import geometry
from objectflow.alignment.frame_pair import FramePair
from objectflow.alignment.likelihood import motion_confidence
from objectflow.methods.postprocess.scoring import set_confidence
from objectflow.methods.postprocess.settings import PostprocessSettings
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


def test_static_objects_and_objects_without_pixels_keep_their_scores() -> None:
    scene = analytic.make_scene(51)
    static = ObjectMotion(1, 10, 0.4, False, np.zeros(3), np.eye(4))
    unseen = ObjectMotion(999, 10, 0.4, True, np.zeros(3), np.eye(4))
    pair = FramePair(scene.prev, scene.curr)
    assert set_confidence(pair, scene.labels, (static, unseen), DEFAULTS)[1] == (static, unseen)
