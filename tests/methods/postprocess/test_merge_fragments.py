"""Merging of fragments: pieces of one body are merged and separate bodies are not, on known masks and motions."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

import analytic
from helpers.truths import true_objects
from objectflow import geometry
from objectflow.alignment.frame_pair import FramePair
from objectflow.alignment.likelihood import LikelihoodSettings
from objectflow.frame import RgbdFrame
from objectflow.geometry.camera import Camera
from objectflow.methods.postprocess.merge_fragments import merge_fragments
from objectflow.methods.postprocess.pair_likelihood import PairLikelihood
from objectflow.methods.postprocess.settings import JointMotionSettings, MergeSettings, PostprocessSettings
from objectflow.motion import ObjectMotion
from objectflow.typing import Float64Array, LabelImage

DEFAULTS = PostprocessSettings()
DEPTH_STEP = MergeSettings().max_depth_step
ONE_OBJECT = 1
TWO_OBJECTS = 2


def cut(scene: analytic.AnalyticPair, number: int, share: float = 0.4) -> tuple[LabelImage, tuple[ObjectMotion, ...]]:
    """The left part of an object becomes a separate object, with a motion that is off by a millimetre."""
    mask = scene.labels == number
    columns = np.nonzero(mask.any(axis=0))[0]
    left = mask & (np.arange(mask.shape[1]) < np.quantile(columns, share))
    new = max(scene.prev_T_curr) + 1
    labels = np.where(left, np.int32(new), scene.labels)
    objects = true_objects(scene)
    (whole,) = (obj for obj in objects if obj.id == number)
    near = geometry.make_transform(np.eye(3), [0.001, 0.0, 0.0]) @ whole.prev_T_curr
    rest = tuple(dataclasses.replace(obj, pixels=int((labels == obj.id).sum())) for obj in objects)
    return labels, (*rest, dataclasses.replace(whole, id=new, pixels=int(left.sum()), score=0.7, prev_T_curr=near))


def test_an_object_cut_in_two_is_merged() -> None:
    merged = 0
    for seed in range(51, 57):
        scene = analytic.make_scene(seed, objects=(3, 5), depth_noise=0.0015)
        number = max(scene.moving, key=lambda k: int((scene.labels == k).sum()))
        labels, objects = cut(scene, number)
        out, found = merge_fragments(FramePair(scene.prev, scene.curr), labels, objects, DEFAULTS)
        if len(found) == len(objects):
            continue
        merged += 1
        # The partition is the original one, under other numbers.
        both = np.unique(np.stack([scene.labels.ravel(), out.ravel()]), axis=1)
        assert both.shape[1] == len(np.unique(scene.labels)) == len(np.unique(out))
        assert [obj.pixels for obj in found] == [int((out == obj.id).sum()) for obj in found]
        assert max(obj.score for obj in found) == 0.7
    assert merged >= 5


def test_separate_bodies_are_not_merged() -> None:
    for seed in range(51, 57):
        scene = analytic.make_scene(seed, objects=(5, 8), depth_noise=0.0015)
        objects = true_objects(scene)
        labels, found = merge_fragments(FramePair(scene.prev, scene.curr), scene.labels, objects, DEFAULTS)
        np.testing.assert_array_equal(labels, scene.labels)
        assert found == objects


def ends_of(scene: analytic.AnalyticPair, number: int) -> tuple[LabelImage, tuple[ObjectMotion, ...]]:
    """The middle of an object is no part of any; its ends are two objects, turned by 2 degrees to either side."""
    mask = scene.labels == number
    low, high = np.quantile(np.nonzero(mask)[1], (0.4, 0.6))
    columns, new = np.arange(mask.shape[1]), max(scene.prev_T_curr) + 1
    ends = {number: mask & (columns < low), new: mask & (columns > high)}
    labels = np.where(mask, 0, scene.labels).astype(np.int32)
    points = geometry.back_project(scene.curr.depth, scene.curr.camera)
    (whole,) = (obj for obj in true_objects(scene) if obj.id == number)
    objects = [obj for obj in true_objects(scene) if obj.id != number]
    for (label, end), angle in zip(ends.items(), (0.035, -0.035), strict=True):
        labels[end] = label
        center = geometry.transform(whole.prev_T_curr, points[end].mean(axis=0))
        rotation = geometry.so3_exp(np.array([0.0, angle, 0.0]))
        motion = geometry.make_transform(rotation, center - rotation @ center) @ whole.prev_T_curr
        objects.append(dataclasses.replace(whole, id=label, pixels=int(end.sum()), prev_T_curr=motion))
    return labels, tuple(objects)


@pytest.mark.parametrize(("seed", "count"), [(40, ONE_OBJECT), (52, ONE_OBJECT), (57, ONE_OBJECT), (46, TWO_OBJECTS)])
def test_ends_of_one_body_are_merged_by_a_motion_that_is_registered_to_both(seed: int, count: int) -> None:
    """The bodies turn by 10, 12, 11 and 0.3 degrees; two bodies that one push shifts have one motion, too."""
    scene = analytic.make_scene(seed, objects=(2, 3), max_angle_deg=12, depth_noise=0.001)
    number = max(scene.moving, key=lambda k: int((scene.labels == k).sum()))
    labels, objects = ends_of(scene, number)
    pair = FramePair(scene.prev, scene.curr)
    never = dataclasses.replace(DEFAULTS, merge=MergeSettings(joint=JointMotionSettings(max_sigmas=0.0)))
    assert len(merge_fragments(pair, labels, objects, never)[1]) == len(objects)
    out, found = merge_fragments(pair, labels, objects, DEFAULTS)
    assert len(found) == len(objects) + count - TWO_OBJECTS
    if count == ONE_OBJECT:
        ends = np.isin(labels, [number, max(scene.prev_T_curr) + 1])
        (label,) = np.unique(out[ends])
        points = geometry.back_project(scene.curr.depth, scene.curr.camera)[ends]
        (body,) = (obj for obj in found if obj.id == label)
        true = geometry.transform(scene.prev_T_curr[number], points)
        off = np.linalg.norm(geometry.transform(body.prev_T_curr, points) - true, axis=1)
        assert off.mean() < 0.002


CAMERA = Camera(width=80, height=60, fx=80.0, fy=80.0, cx=40.0, cy=30.0)
SHIFT = geometry.make_transform(np.eye(3), [0.0, 0.0, 0.1])


def two_halves(gap: float = 0.0) -> tuple[FramePair, LabelImage]:
    """A plate that came 10 cm nearer, in front of a wall: two halves, the right one `gap` metres behind the left."""
    prev, curr = np.full((60, 80), 1.5, np.float32), np.full((60, 80), 1.5, np.float32)
    labels = np.zeros((60, 80), np.int32)
    labels[20:40, 20:35], labels[20:40, 35:60] = 1, 2
    prev[labels == 1], curr[labels == 1] = 0.9, 0.8
    prev[labels == 2], curr[labels == 2] = 0.9 + gap, 0.8 + gap
    color = np.full((60, 80, 3), 120, np.uint8)
    return FramePair(RgbdFrame(color, prev, CAMERA), RgbdFrame(color, curr, CAMERA)), labels


def half(number: int, pixels: int, motion: Float64Array = SHIFT, *, moving: bool = True) -> ObjectMotion:
    return ObjectMotion(number, pixels, 0.5, moving, np.array([0.0, 0.0, 0.8]), motion)


WRONG = geometry.make_transform(np.eye(3), [0.0, 0.0, 0.3])


@pytest.mark.parametrize(
    ("gap", "motion", "moving", "count"),
    [
        pytest.param(0.0, SHIFT, True, ONE_OBJECT, id="one surface and one motion"),
        pytest.param(2 * DEPTH_STEP, SHIFT, True, TWO_OBJECTS, id="a depth step between the halves"),
        pytest.param(0.0, SHIFT, False, TWO_OBJECTS, id="a static half"),
        pytest.param(0.0, WRONG, True, ONE_OBJECT, id="the right motion of the other half explains both"),
    ],
)
def test_conditions_of_merging(gap: float, motion: Float64Array, moving: bool, count: int) -> None:
    pair, labels = two_halves(gap)
    objects = (half(1, 300, motion, moving=moving), half(2, 500))
    out, found = merge_fragments(pair, labels, objects, DEFAULTS)
    assert len(found) == count == len(np.unique(out)) - 1
    if count == ONE_OBJECT:
        np.testing.assert_array_equal(out > 0, labels > 0)
        np.testing.assert_array_equal(found[0].prev_T_curr, SHIFT)
        assert found[0].pixels == 800


@pytest.mark.parametrize(
    ("merge", "count"),
    [
        (MergeSettings(), ONE_OBJECT),
        (MergeSettings(max_depth_step=0.5 * DEPTH_STEP, max_gap_ratio=0.0), TWO_OBJECTS),
        (MergeSettings(max_depth_step=0.5 * DEPTH_STEP, max_gap_ratio=0.0, min_contact=0.0), ONE_OBJECT),
        (MergeSettings(max_loss=0.0), TWO_OBJECTS),
        (MergeSettings(max_cost=0.0), TWO_OBJECTS),
    ],
)
def test_the_settings_decide(merge: MergeSettings, count: int) -> None:
    """Two halves with the same motion, 8 mm apart in depth."""
    pair, labels = two_halves(0.8 * DEPTH_STEP)
    objects = (half(1, 300), half(2, 500))
    settings = dataclasses.replace(DEFAULTS, merge=merge)
    assert len(merge_fragments(pair, labels, objects, settings)[1]) == count


def test_motions_that_explain_nothing_are_not_merged() -> None:
    pair, labels = two_halves()
    wrong = geometry.make_transform(np.eye(3), [0.0, 0.0, -0.3])
    objects = (half(1, 300, wrong), half(2, 500, wrong))
    assert len(merge_fragments(pair, labels, objects, DEFAULTS)[1]) == 2


@pytest.mark.parametrize(
    ("apart", "merge", "count"),
    [
        (0.0, MergeSettings(), ONE_OBJECT),
        (0.0, MergeSettings(agreement_factor=1.0), TWO_OBJECTS),
        (0.014, MergeSettings(), TWO_OBJECTS),
        (0.014, MergeSettings(agreement_sigmas=2.5), ONE_OBJECT),
    ],
)
def test_motions_that_agree_may_fit_worse(apart: float, merge: MergeSettings, count: int) -> None:
    """Both motions are 6 mm off, which costs more than 1 and less than 2; a match is uncertain by 7 mm."""
    pair, labels = two_halves()
    off = geometry.make_transform(np.eye(3), [0.0, 0.0, 0.106])
    beside = geometry.make_transform(np.eye(3), [apart, 0.0, 0.106])
    objects = (half(1, 300, beside), half(2, 500, off))
    settings = dataclasses.replace(DEFAULTS, merge=merge)
    assert 1 < PairLikelihood(pair, DEFAULTS.likelihood).cost(off, labels > 0).mean() < 2
    assert len(merge_fragments(pair, labels, objects, settings)[1]) == count


@pytest.mark.parametrize(
    ("gap", "apart", "merge", "count"),
    [
        pytest.param(0.011, 0.0, MergeSettings(), ONE_OBJECT, id="a small gap and one motion"),
        pytest.param(0.011, 0.0, MergeSettings(max_gap_ratio=0.01), TWO_OBJECTS, id="a smaller largest gap"),
        pytest.param(0.04, 0.0, MergeSettings(), TWO_OBJECTS, id="a large gap"),
        pytest.param(0.04, 0.0, MergeSettings(max_gap_ratio=0.2), ONE_OBJECT, id="a larger largest gap"),
        pytest.param(0.011, 0.02, MergeSettings(), ONE_OBJECT, id="motions that differ, one of which explains both"),
        pytest.param(0.011, 0.02, MergeSettings(max_cost=0.0), TWO_OBJECTS, id="the same, but it may cost nothing"),
    ],
)
def test_pieces_beyond_a_depth_step_are_merged_if_one_motion_explains_both(
    gap: float, apart: float, merge: MergeSettings, count: int
) -> None:
    """The plates have no texture, so a motion that is 2 cm off sideways explains nearly all of them."""
    pair, labels = two_halves(gap)
    beside = geometry.make_transform(np.eye(3), [apart, 0.0, 0.1])
    objects = (half(1, 300, beside), half(2, 500))
    settings = dataclasses.replace(DEFAULTS, merge=merge)
    assert len(merge_fragments(pair, labels, objects, settings)[1]) == count


@pytest.mark.parametrize(
    ("gap", "offset", "merge", "count"),
    [
        pytest.param(0.011, 0.2, MergeSettings(), TWO_OBJECTS, id="beyond a gap, and no motion explains it"),
        pytest.param(0.011, 0.2, MergeSettings(max_apart_piece_cost=6.0), ONE_OBJECT, id="a larger cost beyond a gap"),
        pytest.param(0.0, 0.2, MergeSettings(), TWO_OBJECTS, id="on one surface, and no motion explains it"),
        pytest.param(0.0, 0.2, MergeSettings(max_piece_cost=6.0), ONE_OBJECT, id="a larger cost on one surface"),
        pytest.param(0.0, 0.0, MergeSettings(), ONE_OBJECT, id="explained"),
    ],
)
def test_a_small_piece_is_explained_by_itself(gap: float, offset: float, merge: MergeSettings, count: int) -> None:
    """A small piece of the plate was `offset` metres farther away in the previous frame than under its motion."""
    pair, labels = two_halves(gap)
    labels[(labels == 1) & (np.arange(80) < 33)] = 0
    prev = np.where(labels == 1, pair.prev.frame.depth + np.float32(offset), pair.prev.frame.depth)
    pair = FramePair(dataclasses.replace(pair.prev.frame, depth=prev), pair.curr.frame)
    lost = geometry.make_transform(np.eye(3), [0.0, 0.0, -0.4])
    objects = (half(1, 40, lost if offset else SHIFT), half(2, 500))
    settings = dataclasses.replace(DEFAULTS, merge=merge)
    assert len(merge_fragments(pair, labels, objects, settings)[1]) == count


def test_three_pieces_become_one_object() -> None:
    pair, labels = two_halves()
    labels[20:40, 50:60] = 3
    objects = (half(1, 300), half(2, 300), half(3, 200))
    out, found = merge_fragments(pair, labels, objects, DEFAULTS)
    assert [obj.pixels for obj in found] == [800]
    np.testing.assert_array_equal(out > 0, labels > 0)


def test_contact_is_the_share_of_the_border_without_a_depth_step() -> None:
    """Half of the rows have a step of 5 cm."""
    pair, labels = two_halves()
    curr = pair.curr.frame
    depth = curr.depth.copy()
    depth[30:40, 35:60] += 0.05
    likelihood = PairLikelihood(FramePair(curr, dataclasses.replace(curr, depth=depth)), LikelihoodSettings())
    assert likelihood.contact_ratio(labels, labels == 1, DEPTH_STEP) == pytest.approx({2: 0.5})
    assert likelihood.contact_ratio(labels, labels == 2, DEPTH_STEP) == pytest.approx({1: 0.5})
    assert likelihood.contact_ratio(labels, labels == 1, 0.06) == pytest.approx({2: 1.0})


def test_no_objects() -> None:
    pair, labels = two_halves()
    out, found = merge_fragments(pair, labels, (), DEFAULTS)
    assert found == ()
    np.testing.assert_array_equal(out, labels)
