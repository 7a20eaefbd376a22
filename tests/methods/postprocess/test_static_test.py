"""At rest or not: movers stay movers, what the frames show standing still is brought to rest, by known scenes."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

import analytic
from objectflow import geometry
from objectflow.alignment.likelihood import COST_FREE_SPACE_VIOLATION
from objectflow.frame import RgbdFrame
from objectflow.geometry.camera import Camera
from objectflow.methods.postprocess.pair_likelihood import PairLikelihood
from objectflow.methods.postprocess.static_test import MotionEvidence, find_evidence, reject_static
from objectflow.motion import ObjectMotion
from objectflow.typing import Float64Array


def true_objects(pair: analytic.AnalyticPair, score: float = 0.3) -> tuple[ObjectMotion, ...]:
    return tuple(
        ObjectMotion(k, int((pair.labels == k).sum()), score, True, pair.centers[k], pair.prev_T_curr[k])
        for k in sorted(pair.prev_T_curr)
        if (pair.labels == k).any()
    )


def shifted(obj: ObjectMotion, shift: tuple[float, float, float]) -> ObjectMotion:
    """With a motion that is off by this much, in metres."""
    return dataclasses.replace(obj, prev_T_curr=geometry.make_transform(np.eye(3), list(shift)) @ obj.prev_T_curr)


@pytest.mark.parametrize("width", [320, 800])
def test_movers_keep_their_motions(width: int) -> None:
    for seed in range(51, 55):
        pair = analytic.make_scene(seed, objects=(3, 6), depth_noise=0.0015, width=width, height=width * 3 // 4)
        for obj in reject_static(PairLikelihood(pair.prev, pair.curr, pair.labels), objects := true_objects(pair)):
            (true,) = (one for one in objects if one.id == obj.id)
            moved = np.linalg.norm(true.translation) > 0.02
            assert obj.moving >= moved
            if obj.moving:
                np.testing.assert_array_equal(obj.prev_T_curr, true.prev_T_curr)
            assert (obj.id, obj.pixels, obj.score) == (true.id, true.pixels, true.score)


def test_what_stands_still_is_brought_to_rest() -> None:
    for seed in range(51, 54):
        pair = analytic.make_scene(seed, objects=(3, 6), depth_noise=0.0015, moving_share=0.0)
        start = tuple(shifted(obj, (0.02, 0.01, 0.0)) for obj in true_objects(pair, score=0.9))
        for obj in reject_static(PairLikelihood(pair.prev, pair.curr, pair.labels), start):
            assert not obj.moving
            np.testing.assert_array_equal(obj.prev_T_curr, np.eye(4))


def test_a_small_motion_is_left_as_it_is_and_is_none() -> None:
    pair = analytic.make_scene(51, objects=(2, 2), moving_share=0.0)
    start = tuple(shifted(obj, (0.002, 0.0, 0.0)) for obj in true_objects(pair))
    for old, new in zip(start, reject_static(PairLikelihood(pair.prev, pair.curr, pair.labels), start), strict=True):
        assert not new.moving
        np.testing.assert_array_equal(new.prev_T_curr, old.prev_T_curr)


CAMERA = Camera(width=80, height=60, fx=80.0, fy=80.0, cx=40.0, cy=30.0)
PATCH = np.zeros((60, 80), bool)
PATCH[20:40, 30:50] = True


def frame(depth: float, patch: float | None = None) -> RgbdFrame:
    """A grey wall, and a patch of it at another depth."""
    image = np.full((60, 80), depth, np.float32)
    if patch is not None:
        image[PATCH] = patch
    return RgbdFrame(color=np.full((60, 80, 3), 120, np.uint8), depth=image, camera=CAMERA)


def patch_object(motion: Float64Array, score: float) -> ObjectMotion:
    return ObjectMotion(1, int(PATCH.sum()), score, True, np.array([0.0, 0.0, 1.0]), motion)


FAR = geometry.make_transform(np.eye(3), [0.0, 0.0, 0.3])
"""A motion that nothing in these frames bears out: from behind the wall."""


@pytest.mark.parametrize("score", [0.1, 0.9])
def test_what_cannot_have_stood_still_moved_however_badly_its_motion_fits(score: float) -> None:
    """A patch that stands before the wall, and in the previous frame there was nothing but the wall."""
    (obj,) = reject_static(
        PairLikelihood(frame(1.0), frame(1.0, 0.8), PATCH.astype(np.int32)), (patch_object(FAR, score),)
    )
    assert obj.moving
    np.testing.assert_array_equal(obj.prev_T_curr, FAR)


@pytest.mark.parametrize(("score", "moving"), [(0.3, False), (0.9, True)])
def test_what_was_merely_hidden_moved_only_by_a_sure_word(score: float, moving: bool) -> None:
    """A piece of wall that something stood before: it may have been there, or not."""
    (obj,) = reject_static(
        PairLikelihood(frame(1.0, 0.7), frame(1.0), PATCH.astype(np.int32)), (patch_object(FAR, score),)
    )
    assert obj.moving is moving
    assert np.array_equal(obj.prev_T_curr, FAR if moving else np.eye(4))


def test_the_evidence_is_the_mean_difference_of_the_costs() -> None:
    """Half of the mask before the wall, half on it: a motion by 20 cm explains the first half and not the other."""
    mask = PATCH.copy()
    mask[:, 50:70] = PATCH[:, 30:50]
    likelihood = PairLikelihood(frame(1.0, 1.0), frame(1.0, 0.8), mask.astype(np.int32))
    back = geometry.make_transform(np.eye(3), [0.0, 0.0, 0.2])
    found = find_evidence(likelihood, patch_object(back, 0.5))
    assert found is not None
    # At rest: ruled out, and perfect. Moved: perfect, and 20 cm behind the wall: hidden, far behind, costs 2.
    assert found.gain == pytest.approx((COST_FREE_SPACE_VIOLATION - 2.0) / 2, abs=0.05)
    assert found.stands == pytest.approx(0.5, abs=0.01)
    assert found.impossible == pytest.approx(0.5, abs=0.01)


def test_the_verdict_asks_for_gain_first() -> None:
    assert MotionEvidence(gain=0.5, stands=1.0, impossible=0.0).moved(0.1)
    assert not MotionEvidence(gain=0.1, stands=0.5, impossible=0.5).moved(0.9)
    assert MotionEvidence(gain=-2.0, stands=0.1, impossible=0.5).moved(0.1)
    assert not MotionEvidence(gain=-2.0, stands=0.1, impossible=0.0).moved(0.5)


def test_objects_without_depth_keep_the_network_s_word() -> None:
    curr = frame(1.0)
    empty = dataclasses.replace(curr, depth=np.where(PATCH, 0, curr.depth).astype(np.float32))
    likelihood = PairLikelihood(curr, empty, PATCH.astype(np.int32))
    (obj,) = reject_static(likelihood, (patch_object(FAR, 0.1),))
    assert obj.moving
    assert find_evidence(likelihood, obj) is None
    assert reject_static(likelihood, ()) == ()
