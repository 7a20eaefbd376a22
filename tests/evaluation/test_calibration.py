"""The reliability table: which motions are right, and in which bin they count."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

import analytic
import calibration
from helpers.truths import true_objects, truth_of_scene
from objectflow import SceneMotion, geometry
from objectflow.evaluation.cache import MethodCache, encode


def test_right_and_wrong_motions_are_told_apart() -> None:
    """One true motion, one that is 1 mm off, and one that is 5 cm off."""
    scene = analytic.make_scene(53, objects=(3, 3))
    points = geometry.back_project(scene.curr.depth, scene.curr.camera)
    shifts = dict(zip((obj.id for obj in true_objects(scene)), (0.0, 0.001, 0.05), strict=True))
    objects = tuple(
        dataclasses.replace(
            obj,
            score=0.9 if shifts[obj.id] < 0.01 else 0.4,
            prev_T_curr=geometry.make_transform(np.eye(3), [shifts[obj.id], 0.0, 0.0]) @ obj.prev_T_curr,
        )
        for obj in true_objects(scene, all_moving=True)
    )
    motion = SceneMotion(scene.labels, scene.scene_flow, objects)
    found = list(calibration.judge_movers(motion, truth_of_scene(scene), points))
    assert [one.right for one in found] == [True, True, False]
    # An object beside every true mover is wrong, whatever its motion.
    elsewhere = (scene.labels == 0).astype(np.int32)
    beside = SceneMotion(elsewhere, scene.scene_flow, (dataclasses.replace(objects[0], id=1),))
    assert [one.right for one in calibration.judge_movers(beside, truth_of_scene(scene), points)] == [False]
    rows = list(calibration.reliability_rows(found))
    assert rows[2:] == [
        "| 0 to 0.3 | 0 | - |",
        "| 0.3 to 0.5 | 1 | 0% |",
        "| 0.5 to 0.7 | 0 | - |",
        "| 0.7 to 0.9 | 0 | - |",
        "| 0.9 to 1 | 2 | 100% |",
    ]


def test_a_part_with_the_motion_of_the_whole_is_right() -> None:
    scene = analytic.make_scene(53, objects=(3, 3))
    points = geometry.back_project(scene.curr.depth, scene.curr.camera)
    whole = next(obj for obj in true_objects(scene) if obj.id in scene.moving)
    mask = scene.labels == whole.id
    left = mask & (np.arange(mask.shape[1]) < np.median(np.nonzero(mask)[1]))
    labels = np.where(left, np.int32(1), np.where(mask, np.int32(2), np.int32(0)))
    off = geometry.make_transform(np.eye(3), [0.05, 0.0, 0.0]) @ whole.prev_T_curr
    parts = (dataclasses.replace(whole, id=1), dataclasses.replace(whole, id=2, prev_T_curr=off))
    found = list(calibration.judge_movers(SceneMotion(labels, scene.scene_flow, parts), truth_of_scene(scene), points))
    assert [one.right for one in found] == [True, False]


def test_half_the_displacement_of_an_object_that_hardly_moved_must_be_right() -> None:
    """An object that moved by 3 mm is no mover of the evaluation: 1 mm off is right, 2 mm off and any motion of an
    object at rest are wrong."""
    scene = analytic.make_scene(53, objects=(3, 3))
    points = geometry.back_project(scene.curr.depth, scene.curr.camera)
    truth = truth_of_scene(scene)
    rows = []
    for moved, found in ((0.003, 0.002), (0.003, 0.001), (0.0, 0.003)):
        true_motion, motion = (geometry.make_transform(np.eye(3), [shift, 0.0, 0.0]) for shift in (moved, found))
        objects = tuple(dataclasses.replace(obj, prev_T_curr=true_motion) for obj in truth.objects)
        small = dataclasses.replace(truth, objects=objects, moving=frozenset(), background_prev_T_curr=None)
        mover = dataclasses.replace(true_objects(scene, all_moving=True)[0], prev_T_curr=motion)
        labels = np.where(scene.labels == mover.id, np.int32(mover.id), np.int32(0))
        (judged,) = calibration.judge_movers(SceneMotion(labels, scene.scene_flow, (mover,)), small, points)
        rows.append(judged.right)
    assert rows == [True, False, False]


def test_results_that_were_written_before_are_judged(tmp_path: Path) -> None:
    scene = analytic.make_scene(53, objects=(3, 3))
    motion = SceneMotion(scene.labels, scene.scene_flow, true_objects(scene))
    cache = MethodCache(tmp_path / "predictions" / "rigidmatch")
    with cache.claim({}):
        cache.write("test-000003", encode(motion, key="test-000003", cold=False, machine="any"))
    read = calibration.results(tmp_path, "rigidmatch")
    found = read("test-000003", scene.prev, scene.curr)
    np.testing.assert_array_equal(found.labels, scene.labels)
    np.testing.assert_allclose(found.objects[0].prev_T_curr, motion.objects[0].prev_T_curr)
    with pytest.raises(SystemExit, match="no result of test-000004"):
        read("test-000004", scene.prev, scene.curr)
