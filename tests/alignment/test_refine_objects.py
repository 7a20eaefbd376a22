"""+Refine: wrong motions are corrected, correct motions stay, and no object's depth cost grows."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

import analytic
from helpers.truths import true_objects
from objectflow import geometry
from objectflow.alignment import registration
from objectflow.alignment.frame_pair import FramePair
from objectflow.alignment.refine_objects import RefineSettings, depth_cost, refine_objects, refine_one
from objectflow.geometry.depth_noise import DepthNoise
from objectflow.motion import ObjectMotion


def disturbed(obj: ObjectMotion, metres: float, degrees: float, rng: np.random.Generator) -> ObjectMotion:
    """The object with its centre displaced by `metres` and its motion rotated about that centre by `degrees`."""
    shift, turn = rng.normal(size=(2, 3))
    shift *= metres / np.linalg.norm(shift)
    turn *= np.radians(degrees) / np.linalg.norm(turn)
    R = geometry.so3_exp(turn) @ obj.prev_T_curr[:3, :3]
    end = geometry.transform(obj.prev_T_curr, obj.center) + shift
    return dataclasses.replace(obj, prev_T_curr=geometry.make_transform(R, end - R @ obj.center))


def disturbed_objects(
    scene: analytic.AnalyticPair, metres: float, degrees: float, rng: np.random.Generator
) -> tuple[ObjectMotion, ...]:
    return tuple(disturbed(obj, metres, degrees, rng) for obj in true_objects(scene, all_moving=True))


def error(scene: analytic.AnalyticPair, obj: ObjectMotion) -> float:
    """Mean distance in metres of the object's points from their true previous positions."""
    mask = (scene.labels == obj.id) & scene.curr.valid
    points = geometry.back_project(scene.curr.depth, scene.curr.camera)[mask].astype(np.float64)
    off = geometry.transform(obj.prev_T_curr, points) - points - scene.scene_flow[mask]
    return float(np.linalg.norm(off, axis=1).mean())


@pytest.mark.parametrize(("metres", "degrees", "share"), [(0.01, 5, 0.2), (0.04, 20, 0.4)])
def test_wrong_motions_are_corrected(metres: float, degrees: float, share: float) -> None:
    """From 4 cm off, most registrations converge only from the fit to the matches."""
    rng = np.random.default_rng(0)
    before, after = [], []
    for seed in range(51, 54):
        scene = analytic.make_scene(seed, objects=(3, 6), depth_noise=0.0015)
        start, pair = disturbed_objects(scene, metres, degrees, rng), FramePair(scene.prev, scene.curr)
        for old, new in zip(start, refine_objects(pair, scene.labels, start), strict=True):
            assert (new.id, new.pixels, new.score) == (old.id, old.pixels, old.score)
            np.testing.assert_array_equal(new.center, old.center)
            before.append(error(scene, old))
            after.append(error(scene, new))
    assert len(after) >= 10
    assert np.median(after) < 0.001
    assert np.mean(after) < share * np.mean(before)


@pytest.mark.parametrize("width", [RefineSettings.width, 320])
def test_wide_frames_are_refined(width: int) -> None:
    """Frames are registered at the width of the settings, and labels stay on the pixels of the full image."""
    scene = analytic.make_scene(51, objects=(2, 2), width=800, height=600)
    start = disturbed_objects(scene, 0.01, 5, np.random.default_rng(1))
    pair = FramePair(scene.prev, scene.curr)
    for new in refine_objects(pair, scene.labels, start, RefineSettings(width=width)):
        assert error(scene, new) < 0.001
    assert {"matches", "target", "sources"} <= pair.at_width(width).__dict__.keys()
    assert "matches" not in pair.__dict__


def test_no_objects_depth_cost_grows() -> None:
    rng = np.random.default_rng(2)
    scene = analytic.make_scene(60, objects=(5, 5), depth_noise=0.002)
    target = registration.RegistrationTarget(scene.prev)
    pair = FramePair(scene.prev, scene.curr)
    for metres, degrees in ((0.0, 1e-9), (0.03, 30), (0.3, 90)):
        start = disturbed_objects(scene, metres, degrees, rng)
        for old, new in zip(start, refine_objects(pair, scene.labels, start), strict=True):
            source = registration.RegistrationSources(scene.curr).take(scene.labels == old.id, limit=2000)
            costs = [
                depth_cost(registration.evaluate_registration(target, source, obj.prev_T_curr), target, source)
                for obj in (old, new)
            ]
            assert costs[1] <= costs[0]


def lured() -> tuple[registration.RegistrationTarget, registration.RegistrationSource]:
    """The object has vanished; only a strip half as wide has about its depth in the previous frame."""
    height, width = 120, 160
    curr_depth = np.full((height, width), 1.0, np.float32)
    curr_depth[40:80, 60:100] = 0.6
    prev_depth = np.full((height, width), 1.0, np.float32)
    prev_depth[40:80, 85:105] = 0.57
    frame = analytic.make_scene(1, width=width, height=height).prev
    mask = np.zeros((height, width), bool)
    mask[40:80, 60:100] = True
    source = registration.RegistrationSources(dataclasses.replace(frame, depth=curr_depth)).take(mask)
    return registration.RegistrationTarget(dataclasses.replace(frame, depth=prev_depth)), source


STRIP = geometry.make_transform(np.eye(3), [0.03, 0.0, -0.03])
"""The motion that places half of the object on that strip."""


def test_a_distant_motion_that_fits_only_a_part_is_rejected() -> None:
    target, source = lured()
    assert depth_cost(registration.evaluate_registration(target, source, STRIP), target, source) < depth_cost(
        registration.evaluate_registration(target, source, np.eye(4)), target, source
    )
    np.testing.assert_array_equal(refine_one(target, source, [np.eye(4), STRIP]), np.eye(4))


@pytest.mark.parametrize(
    "settings",
    [RefineSettings(trusted_fitness=0.3), RefineSettings(max_shift=0.1, max_rotation_deg=90)],
    ids=["trusted_fitness", "max_shift"],
)
def test_the_settings_decide_which_motion_is_accepted(settings: RefineSettings) -> None:
    target, source = lured()
    found = refine_one(target, source, [np.eye(4), STRIP], settings)
    center = source.points.mean(axis=0, dtype=np.float64)
    assert geometry.transform(found, center)[2] == pytest.approx(0.57, abs=0.002)


@pytest.mark.parametrize(("metres", "tried"), [(0.005, 1), (0.3, 2)])
def test_further_starts_are_tried_only_where_the_first_does_not_fit(metres: float, tried: int) -> None:
    scene = analytic.make_scene(51, objects=(1, 1), depth_noise=0.0015)
    (obj,) = true_objects(scene, all_moving=True)
    pair = FramePair(scene.prev, scene.curr)
    source = pair.sources.take(scene.labels == obj.id)
    first = disturbed(obj, metres, 0.5, np.random.default_rng(3)).prev_T_curr
    starts = iter([first, obj.prev_T_curr])
    found = refine_one(pair.target, source, starts)
    assert len(list(starts)) == 2 - tried
    assert error(scene, dataclasses.replace(obj, prev_T_curr=found)) < 0.003


def test_depth_cost_is_the_truncated_mean_square() -> None:
    """A wall at 1 m, measured again 2 mm behind for one half and far off for the other, against a sum over points."""
    wall = np.full((60, 80), 1.0, np.float32)
    frame = dataclasses.replace(analytic.make_scene(1, width=80, height=60).prev, depth=wall)
    moved = wall.copy()
    moved[:, :40] += 0.002
    moved[:, 40:] -= 0.3
    left = np.zeros((60, 80), bool)
    left[5:55, 5:35] = True
    right = left[:, ::-1]
    for noise, sigma in ((DepthNoise(), 0.0012 + 0.0019 * 0.6**2), (DepthNoise(base=0.003, growth=0.0), 0.003)):
        target = registration.RegistrationTarget(dataclasses.replace(frame, depth=moved), noise)
        limit = (3 * sigma) ** 2
        for mask, expected in ((left, 0.002**2), (right, limit), (left | right, (0.002**2 + limit) / 2)):
            source = registration.RegistrationSources(frame).take(mask)
            found = registration.evaluate_registration(target, source, np.eye(4))
            assert depth_cost(found, target, source) == pytest.approx(expected, rel=1e-3)


def test_objects_without_pixels_or_points_keep_their_motion() -> None:
    scene = analytic.make_scene(1, width=80, height=60)
    pair = FramePair(scene.prev, scene.curr)
    assert refine_objects(pair, scene.labels, ()) == ()
    obj = dataclasses.replace(true_objects(scene, all_moving=True)[0], id=40)
    (kept,) = refine_objects(pair, scene.labels, (obj,))
    np.testing.assert_array_equal(kept.prev_T_curr, obj.prev_T_curr)
    nothing = registration.RegistrationSources(scene.curr).take(np.zeros((60, 80), bool))
    np.testing.assert_array_equal(
        refine_one(registration.RegistrationTarget(scene.prev), nothing, [np.eye(4)]), np.eye(4)
    )


def test_objects_that_turn_out_static_are_marked_so() -> None:
    scene = analytic.make_scene(52, objects=(2, 2), moving_share=0.0)
    start = disturbed_objects(scene, 0.01, 5, np.random.default_rng(3))
    pair = FramePair(scene.prev, scene.curr)
    assert [obj.moving for obj in refine_objects(pair, scene.labels, start)] == [False, False]
    strict = RefineSettings(static_displacement=0.0)
    assert [obj.moving for obj in refine_objects(pair, scene.labels, start, strict)] == [True, True]
