"""The steps after a network: each is pure, and any selection in any order works."""

from __future__ import annotations

import dataclasses
from functools import cache

import numpy as np
import pytest

import analytic
from helpers.truths import true_objects
from objectflow import geometry
from objectflow.alignment.frame_pair import FramePair
from objectflow.alignment.refine_objects import refine_objects
from objectflow.errors import SettingsError
from objectflow.methods.labels import Objects, relabel_present
from objectflow.methods.postprocess.changes import StepChange
from objectflow.methods.postprocess.pipeline import STEPS, check_steps, postprocess
from objectflow.methods.postprocess.scoring import set_confidence
from objectflow.methods.postprocess.settings import PostprocessSettings
from objectflow.methods.postprocess.static_test import reject_static
from objectflow.motion import ObjectMotion
from objectflow.typing import LabelImage

LABEL_SIZE = (60, 80)
DEFAULTS = PostprocessSettings(label_size=LABEL_SIZE)


@cache
def network_output() -> tuple[analytic.AnalyticPair, LabelImage, Objects]:
    """A scene, and what a network might make of it: coarse labels with a fragment and a missed object.

    One object has a wrong motion, one is static with a low score.
    """
    scene = analytic.make_scene(53, objects=(5, 5), depth_noise=0.0015)
    rows, columns = (np.arange(240) // 4 * 4 + 2, np.arange(320) // 4 * 4 + 2)
    labels = scene.labels[rows[:, None], columns].copy()
    by_size = sorted(true_objects(scene), key=lambda obj: -obj.pixels)
    cut, wrong, low, missed = by_size[0], by_size[1], by_size[2], by_size[3]
    fragment = (labels == cut.id) & (np.arange(320) < np.median(np.nonzero(labels == cut.id)[1]))
    labels[fragment], labels[labels == missed.id] = 6, 0
    objects = [
        *(obj for obj in by_size if obj not in (wrong, low, missed)),
        dataclasses.replace(cut, id=6, score=0.7),
        dataclasses.replace(wrong, prev_T_curr=geometry.make_transform(np.eye(3), [0.05, 0, 0]) @ wrong.prev_T_curr),
        dataclasses.replace(low, prev_T_curr=np.eye(4), moving=False, score=0.1),
    ]
    return scene, *relabel_present(labels, tuple(sorted(objects, key=lambda obj: obj.id)))


def images(pair: FramePair) -> list[np.ndarray]:
    """Everything that the frames of a pair hold."""
    return [image for one in (pair.prev.frame, pair.curr.frame) for image in (one.color, one.depth)]


def assert_same(found: Objects, expected: Objects) -> None:
    assert [obj.to_dict() for obj in found] == [obj.to_dict() for obj in expected]


@pytest.mark.parametrize("name", STEPS)
def test_steps_are_pure(name: str) -> None:
    """A step changes neither its inputs nor its result when it is repeated on the same prepared pair."""
    scene, labels, objects = network_output()
    pair = FramePair(scene.prev, scene.curr)
    kept_labels, kept_images = labels.copy(), [image.copy() for image in images(pair)]
    kept = tuple(
        dataclasses.replace(obj, center=obj.center.copy(), prev_T_curr=obj.prev_T_curr.copy()) for obj in objects
    )
    first = STEPS[name](pair, labels, objects, DEFAULTS)
    second = STEPS[name](pair, labels, objects, DEFAULTS)
    other = STEPS[name](FramePair(scene.prev, scene.curr), labels, objects, DEFAULTS)
    np.testing.assert_array_equal(labels, kept_labels)
    for image, copy in zip(images(pair), kept_images, strict=True):
        np.testing.assert_array_equal(image, copy)
    assert_same(objects, kept)
    for again in (second, other):
        np.testing.assert_array_equal(first[0], again[0])
        assert_same(first[1], again[1])
    assert first[0].shape == labels.shape
    assert first[0].dtype == np.int32
    assert set(np.unique(first[0])) - {0} <= {obj.id for obj in first[1]}


def test_without_steps_the_input_is_the_result() -> None:
    scene, labels, objects = network_output()
    out, found = postprocess(FramePair(scene.prev, scene.curr), labels, objects, PostprocessSettings(steps=()))
    assert out is labels
    assert found is objects


def test_a_shorter_pipeline_is_the_composition_of_its_steps() -> None:
    """In another order than the default."""
    scene, labels, objects = network_output()
    pair = FramePair(scene.prev, scene.curr)
    settings = PostprocessSettings(steps=("confidence", "static_test", "refine"))
    changes: list[StepChange] = []
    out, found = postprocess(pair, labels, objects, settings, changes)
    _, expected = set_confidence(pair, labels, objects, settings)
    _, expected = reject_static(pair, labels, expected, settings)
    assert_same(found, refine_objects(pair, labels, expected, settings.refine))
    np.testing.assert_array_equal(out, labels)
    assert [change.step for change in changes] == ["confidence", "static_test", "refine"]


@pytest.mark.parametrize("steps", [DEFAULTS.steps, DEFAULTS.steps[::-1], ("merge", "refine", "merge")])
def test_steps_run_in_the_given_order(steps: tuple[str, ...], monkeypatch: pytest.MonkeyPatch) -> None:
    """Each step receives the result of the one before it."""
    calls: list[str] = []

    def recorded(
        name: str, _: FramePair, labels: LabelImage, objects: Objects, __: PostprocessSettings
    ) -> tuple[LabelImage, Objects]:
        assert labels[0, 0] == len(calls)
        calls.append(name)
        return labels + 1, objects

    for name in STEPS:
        monkeypatch.setitem(STEPS, name, lambda *arguments, name=name: recorded(name, *arguments))
    scene = network_output()[0]
    nothing = np.zeros((2, 2), np.int32)
    out, _ = postprocess(FramePair(scene.prev, scene.curr), nothing, (), dataclasses.replace(DEFAULTS, steps=steps))
    assert calls == list(steps)
    assert (out == len(steps)).all()


def test_the_default_steps_repair_the_output() -> None:
    """The fragment is merged, the wrong motion corrected, the missed object found, and each step is recorded."""
    scene, labels, objects = network_output()
    changes: list[StepChange] = []
    out, found = postprocess(FramePair(scene.prev, scene.curr), labels, objects, DEFAULTS, changes)
    assert [change.step for change in changes] == list(DEFAULTS.steps)
    by_step = {change.step: change for change in changes}
    assert any(change.merged for change in changes if change.step == "merge")
    assert by_step["missed_objects"].added
    assert by_step["refine"].replaced
    assert by_step["confidence"].rescored
    for label in scene.moving:
        mask = scene.labels == label
        best = max(found, key=lambda obj: int((mask & (out == obj.id)).sum()))
        assert best.moving
        assert 2 * (mask & (out == best.id)).sum() > 0.8 * (mask.sum() + (out == best.id).sum())
        off = geometry.transform(best.prev_T_curr, scene.centers[label]) - geometry.transform(
            scene.prev_T_curr[label], scene.centers[label]
        )
        assert np.linalg.norm(off) < 0.01


def test_the_default_order_has_every_step_but_one() -> None:
    """Found objects are tested as well, and masks touch only after reassignment, so two steps occur twice."""
    steps = list(DEFAULTS.steps)
    assert set(STEPS) - set(steps) == {"snap_to_edges"}
    assert {name for name in steps if steps.count(name) > 1} == {"static_test", "merge"}
    once = list(dict.fromkeys(steps))
    assert once == [name for name in STEPS if name in once]
    last = steps[steps.index("missed_objects") :]
    assert last[:2] == ["missed_objects", "static_test"]
    assert last[2:] == ["rest_hidden", "drop_without_outline", "drop_uncertain", "confidence"]


def test_borders_move_only_where_labels_were_found_on_a_smaller_image() -> None:
    scene, labels, objects = network_output()
    pair = FramePair(scene.prev, scene.curr)
    step = STEPS["snap_to_edges"]
    kept, same = step(pair, labels, objects, PostprocessSettings())
    assert kept is labels
    assert same is objects
    snapped, found = step(pair, labels, objects, DEFAULTS)
    known = scene.labels != 0
    before, after = ((one > 0) != known for one in (labels, snapped))
    assert after.sum() < 0.7 * before.sum()
    assert [obj.pixels for obj in found] == [int((snapped == obj.id).sum()) for obj in found]


@pytest.mark.parametrize(
    ("minimum", "unexplained", "kept"),
    [(0.0, 0.0, [1, 2, 3, 4]), (0.3, 0.2, [1, 3, 4]), (0.3, 0.26, [1, 3]), (0.6, 0.2, [1, 4]), (0.6, 0.6, [1])],
)
def test_static_objects_of_low_score_are_dropped(minimum: float, unexplained: float, kept: list[int]) -> None:
    """Objects 1 and 4 are where something moved; standing still explains 2 and 3, which are background."""
    scene = network_output()[0]
    first, second = sorted(scene.moving, key=lambda k: -int((scene.labels == k).sum()))[:2]
    labels = np.select([scene.labels == first, scene.labels == second], [1, 4], 0).astype(np.int32)
    labels[:20][scene.labels[:20] == 0], labels[-20:][scene.labels[-20:] == 0] = 2, 3
    objects = tuple(
        ObjectMotion(k, int((labels == k).sum()), score, moving, np.zeros(3), np.eye(4))
        for k, score, moving in ((1, 0.05, True), (2, 0.25, False), (3, 0.5, False), (4, 0.25, False))
    )
    settings = PostprocessSettings(min_static_score=minimum, min_unexplained_score=unexplained)
    out, found = STEPS["drop_uncertain"](FramePair(scene.prev, scene.curr), labels, objects, settings)
    assert [obj.score for obj in found] == [objects[k - 1].score for k in kept]
    expected = np.zeros_like(labels)
    for number, k in enumerate(kept, 1):
        expected[labels == k] = number
    np.testing.assert_array_equal(out, expected)


@pytest.mark.parametrize(
    ("score", "share", "tiny", "right", "count"),
    [
        (0.1, 1.0, 0.0, False, 0),
        (0.1, 0.0, 0.0, False, 1),
        (0.1, 1.0, 0.0, True, 1),
        (0.3, 1.0, 0.0, False, 1),
        (0.3, 1.0, 1.0, False, 0),
        (0.3, 1.0, 1.0, True, 1),
        (0.5, 1.0, 1.0, False, 1),
    ],
)
def test_small_moving_objects_that_nothing_explains_are_dropped(
    score: float, share: float, tiny: float, right: bool, count: int
) -> None:
    scene = network_output()[0]
    number = max(scene.moving, key=lambda k: int((scene.labels == k).sum()))
    labels = (scene.labels == number).astype(np.int32)
    motion = scene.prev_T_curr[number] if right else geometry.make_transform(np.eye(3), [0.0, 0.0, -0.3])
    obj = ObjectMotion(1, int(labels.sum()), score, True, np.zeros(3), motion)
    settings = PostprocessSettings(min_unexplained_share=share, tiny_share=tiny)
    out, found = STEPS["drop_uncertain"](FramePair(scene.prev, scene.curr), labels, (obj,), settings)
    assert len(found) == count
    np.testing.assert_array_equal(out, labels * count)


def test_unknown_steps_are_named() -> None:
    check_steps(PostprocessSettings(steps=()))
    with pytest.raises(SettingsError, match=r"postprocess\.steps has no step 'polish': choose among refine, "):
        check_steps(PostprocessSettings(steps=("refine", "polish")))
