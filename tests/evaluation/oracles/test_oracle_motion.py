"""True motions through our grouping and averaging give the truth, except for indistinguishable objects."""

from __future__ import annotations

import numpy as np
import pytest

import analytic
from helpers.truths import truth_of_scene
from objectflow.errors import ResultError
from objectflow.evaluation.data.truth import make_pair_truth
from objectflow.evaluation.metrics.pair_score import score_pair
from objectflow.evaluation.oracles.oracle_motion import OracleMotion
from objectflow.methods.sceneflownet.grouping import GroupingSettings


@pytest.mark.parametrize("seed", range(5))
def test_true_motions_give_the_truth_back(seed: int) -> None:
    scene = analytic.make_scene(seed)
    truth = truth_of_scene(scene)
    motion = OracleMotion(truth, settings=GroupingSettings(min_pixels=1))(scene.prev, scene.curr)
    score = score_pair(motion, truth)
    assert score.segmentation.fbms == score.segmentation.overlap == (1, 1, 1)
    assert score.flow.all.epe_cm < 1e-3
    assert all(error.rotation_deg < 0.1 and error.translation_cm < 1e-3 for error in score.objects)


def test_errors_of_the_grouping_are_visible() -> None:
    scene = analytic.make_scene(2, objects=(2, 2))
    truth = truth_of_scene(scene)
    small, large = sorted(int((scene.labels == label).sum()) for label in (1, 2))
    # With a minimum size above that of the smaller object, its pixels join the larger one.
    motion = OracleMotion(truth, settings=GroupingSettings(min_pixels=small + 1))(scene.prev, scene.curr)
    assert [obj.pixels for obj in motion.objects] == [small + large]
    score = score_pair(motion, truth)
    # One pair of objects has `large` common pixels, of small + large predicted and as many true ones.
    share = large / (small + large)
    assert score.segmentation.overlap == pytest.approx((share, share, share))
    assert score.flow.masked.epe_cm > 0.5


def test_no_objects_and_a_truth_of_another_size() -> None:
    scene = analytic.make_scene(1, objects=(1, 1))
    empty = make_pair_truth("pair", scene.curr, np.zeros_like(scene.labels), [])
    motion = OracleMotion(empty)(scene.prev, scene.curr)
    assert motion.objects == ()
    assert not np.nan_to_num(motion.scene_flow).any()
    other = analytic.make_scene(1, objects=(1, 1), width=160, height=120)
    with pytest.raises(ResultError, match="the truth is"):
        OracleMotion(empty)(other.prev, other.curr)
