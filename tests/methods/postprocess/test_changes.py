"""Descriptions of what a step changed, on small label images."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from objectflow import geometry
from objectflow.methods.labels import Objects
from objectflow.methods.postprocess.changes import StepChange, describe_change
from objectflow.motion import ObjectMotion
from objectflow.typing import Float64Array, LabelImage

SHIFT = geometry.make_transform(np.eye(3), [0.05, 0.0, 0.0])


def image(*boxes: tuple[int, int, int]) -> LabelImage:
    """(10, 30) labels; each box is (label, first column, end column) and covers rows 2..8, 6 pixels per column."""
    labels = np.zeros((10, 30), np.int32)
    for label, first, end in boxes:
        labels[2:8, first:end] = label
    return labels


def obj(number: int, motion: Float64Array = SHIFT, *, score: float = 0.5, moving: bool = True) -> ObjectMotion:
    return ObjectMotion(number, 60, score, moving, np.array([0.1, 0.0, 1.0]), motion)


OLD_LABELS = image((1, 0, 10), (2, 12, 20))
OLD: Objects = (obj(1), obj(2))
NOTHING = StepChange("step", (), (), (), (), (), (), 0, ())


def change(labels: LabelImage, objects: Objects) -> StepChange:
    return describe_change("step", OLD_LABELS, OLD, labels, objects)


def test_the_same_objects_are_no_change() -> None:
    assert change(OLD_LABELS.copy(), tuple(dataclasses.replace(one) for one in OLD)) == NOTHING
    assert NOTHING.words() == "nothing changed"


def test_other_numbers_are_no_change() -> None:
    assert change(image((2, 0, 10), (1, 12, 20)), (obj(1), obj(2))) == NOTHING


def test_an_added_object() -> None:
    found = change(image((1, 0, 10), (2, 12, 20), (3, 22, 25)), (*OLD, obj(3)))
    assert found == dataclasses.replace(NOTHING, added=(3,), relabelled=18)
    assert found.words() == "added 3; 18 pixels relabelled"


def test_an_added_object_that_takes_a_few_pixels_of_another_one() -> None:
    found = change(image((1, 0, 9), (3, 9, 12), (2, 12, 20)), (*OLD, obj(3)))
    assert (found.added, found.dropped, found.merged, found.relabelled) == ((3,), (), (), 18)


def test_a_dropped_object() -> None:
    found = change(image((1, 12, 20)), (obj(1),))
    assert found == dataclasses.replace(NOTHING, dropped=(1,), relabelled=60)
    assert found.words() == "dropped 1; 60 pixels relabelled"


def test_merged_objects() -> None:
    """The larger object takes in the smaller one and keeps its number; the gap between them stays background."""
    found = change(image((1, 0, 10), (1, 12, 20)), (obj(1),))
    assert found == dataclasses.replace(NOTHING, merged=((2, 1),), relabelled=48)
    assert found.words() == "merged 2 into 1; 48 pixels relabelled"


def test_objects_that_became_static_or_moving() -> None:
    static = (obj(1, np.eye(4), moving=False), obj(2))
    found = change(OLD_LABELS, static)
    assert (found.stopped, found.started) == ((1,), ())
    assert found.replaced == ((1, pytest.approx(0.05), 0.0),)
    assert found.words() == "now static 1; motion of 1 changed by 5.0 cm, 0.0 deg"
    back = describe_change("step", OLD_LABELS, static, OLD_LABELS, OLD)
    assert (back.stopped, back.started) == ((), (1,))
    assert back.words().startswith("now moving 1; ")


def test_a_replaced_motion() -> None:
    """A rotation by 10 degrees about the centre's end point, which is then shifted by 2 cm."""
    end = geometry.transform(SHIFT, OLD[1].center)
    R = geometry.so3_exp([0.0, 0.0, np.radians(10)])
    motion = geometry.make_transform(R, end - R @ end + np.array([0.0, 0.02, 0.0])) @ SHIFT
    found = change(OLD_LABELS, (OLD[0], obj(2, motion)))
    assert found.replaced == ((2, pytest.approx(0.02), pytest.approx(10.0)),)
    assert found.words() == "motion of 2 changed by 2.0 cm, 10.0 deg"
    # Differences far below the resolution of a depth camera are none.
    near = geometry.make_transform(np.eye(3), [0.0002, 0.0, 0.0]) @ SHIFT
    assert change(OLD_LABELS, (OLD[0], obj(2, near))) == NOTHING


def test_other_scores() -> None:
    found = change(OLD_LABELS, (obj(1, score=0.9), OLD[1]))
    assert found == dataclasses.replace(NOTHING, rescored=(1,))
    assert found.words() == "scores of 1"


def test_an_object_that_grows_many_times_is_the_same_object() -> None:
    found = describe_change("step", image((1, 0, 2)), (obj(1),), image((1, 0, 20)), (obj(1),))
    assert found == dataclasses.replace(NOTHING, relabelled=18 * 6)


def test_the_parts_of_a_split_object() -> None:
    """The larger part is the object itself, the smaller one is added."""
    found = describe_change("step", image((1, 0, 20)), (obj(1),), image((1, 0, 8), (2, 8, 20)), (obj(1), obj(2)))
    assert (found.added, found.dropped, found.merged, found.relabelled) == ((1,), (), (), 48)


def test_without_objects() -> None:
    nothing = np.zeros((10, 30), np.int32)
    assert describe_change("step", nothing, (), nothing, ()) == NOTHING
