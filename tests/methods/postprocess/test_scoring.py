"""Scores of moving objects: high for true motions, low for wrong ones, by scenes whose truth is known."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

import analytic
from objectflow import geometry
from objectflow.alignment.likelihood import motion_confidence
from objectflow.methods.postprocess.pair_likelihood import PairLikelihood
from objectflow.methods.postprocess.scoring import set_confidence
from objectflow.motion import ObjectMotion


def test_certainty_in_numbers() -> None:
    cost = np.array([0.0, 0.0, 0.0, 5.0], np.float32)
    assert motion_confidence(cost, np.full(4, 1.0, np.float32)) == pytest.approx(0.75 * (1 - np.exp(-2)), abs=1e-4)
    assert motion_confidence(cost, np.zeros(4, np.float32)) == 0
    assert motion_confidence(cost, np.full(4, -1.0, np.float32)) == 0  # worse than its rival
    assert motion_confidence(cost[:3], np.full(3, 50.0, np.float32)) == 1


@pytest.mark.parametrize("seed", [51, 53, 56])
def test_true_motions_score_high_and_wrong_ones_low(seed: int) -> None:
    pair = analytic.make_scene(seed, objects=(3, 5), depth_noise=0.0015, width=320, height=240)
    likelihood = PairLikelihood(pair.prev, pair.curr, pair.labels)
    for k, motion in pair.prev_T_curr.items():
        obj = ObjectMotion(k, int((pair.labels == k).sum()), 0.5, True, pair.centers[k], motion)
        if obj.pixels < 500 or np.linalg.norm(obj.translation) < 0.02:
            continue
        wrong = geometry.make_transform(np.eye(3), [0.0, 0.0, -0.04]) @ motion  # hangs before what was seen
        (right,) = set_confidence(likelihood, (obj,))
        (off,) = set_confidence(likelihood, (dataclasses.replace(obj, prev_T_curr=wrong),))
        assert right.score > 0.7
        assert off.score < 0.1
        assert (right.id, right.pixels, right.moving) == (obj.id, obj.pixels, obj.moving)


def test_others_keep_their_scores() -> None:
    pair = analytic.make_scene(51)
    likelihood = PairLikelihood(pair.prev, pair.curr, pair.labels)
    still = ObjectMotion(1, 10, 0.4, False, np.zeros(3), np.eye(4))
    unseen = ObjectMotion(999, 10, 0.4, True, np.zeros(3), np.eye(4))
    assert set_confidence(likelihood, (still, unseen)) == (still, unseen)
