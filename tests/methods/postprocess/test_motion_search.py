"""The search for motions: its costs by closed forms, positions and motions on scenes with known motions."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import analytic
from helpers.truths import true_objects
from objectflow import geometry
from objectflow.alignment.frame_pair import FramePair
from objectflow.alignment.likelihood import LikelihoodSettings
from objectflow.errors import SettingsError
from objectflow.frame import RgbdFrame
from objectflow.geometry.camera import Camera
from objectflow.methods.postprocess.color_proposals import propose_positions
from objectflow.methods.postprocess.motion_search import search_motions
from objectflow.methods.postprocess.search_likelihood import SearchLikelihood
from objectflow.methods.postprocess.search_settings import (
    FeatureMotionSettings,
    MotionSearchSettings,
    SearchLevelSettings,
)
from objectflow.methods.postprocess.settings import PostprocessSettings
from objectflow.motion import ObjectMotion
from objectflow.settings import build

CAMERA = Camera(160, 120, 120.0, 120.0, 79.5, 59.5)
DEFAULTS = PostprocessSettings()
NO_FEATURES = FeatureMotionSettings(min_inliers=10**6)
COST_OUT_OF_VIEW = MotionSearchSettings().cost_out_of_view
COST_FREE_SPACE_VIOLATION = LikelihoodSettings().free_space_violation


def wall(depth: float = 1.0, grey: int = 128) -> RgbdFrame:
    return RgbdFrame(np.full((120, 160, 3), grey, np.uint8), np.full((120, 160), depth, np.float32), CAMERA)


def search_likelihood(prev: RgbdFrame, curr: RgbdFrame) -> SearchLikelihood:
    return SearchLikelihood(
        FramePair(prev, curr), cost_out_of_view=COST_OUT_OF_VIEW, free_space_violation=COST_FREE_SPACE_VIOLATION
    )


def cost_of(prev: RgbdFrame, shift: tuple[float, float, float], grey: int = 128) -> float:
    """Cost of a point in the middle of a grey wall at 1 m, shifted."""
    frames = search_likelihood(prev, wall(grey=grey))
    point, appearance = np.array([[0.0, 0.0, 1.0]], np.float32), frames.curr_appearance[60:61, 80]
    (cost,) = frames(np.eye(3)[None], np.array([shift]), point, appearance, depth_scale=0.02, color_scale=10.0)
    return float(cost)


@pytest.mark.parametrize(
    ("shift", "expected"),
    [
        ((0, 0, 0), 0.0),
        ((0.1, 0, 0), 0.0),  # along the wall
        ((0, 0, 0.02), 0.5),  # the depth scale
        ((0, 0, -0.04), 2.0),  # 0.5 * 2^2, in front of the wall
        ((0, 0, -0.061), COST_FREE_SPACE_VIOLATION),
        ((0, 0, 0.041), COST_OUT_OF_VIEW),  # behind the wall
        ((2.0, 0, 0), COST_OUT_OF_VIEW),  # outside the image
        ((0, 0, -2.0), COST_FREE_SPACE_VIOLATION),  # behind the camera, and therefore in front of the wall
    ],
)
def test_cost_of_depth(shift: tuple[float, float, float], expected: float) -> None:
    assert cost_of(wall(), shift) == pytest.approx(expected, abs=1e-4)


def test_cost_of_colour() -> None:
    assert cost_of(wall(grey=0), (0, 0, 0), grey=255) == pytest.approx(2.0, abs=1e-5)  # the highest
    # OpenCV's 8-bit lightness of 128 and 160 is 137 and 168; its weight is a quarter.
    assert cost_of(wall(grey=128), (0, 0, 0), grey=160) == pytest.approx(0.5 * ((168 - 137) / 4 / 10) ** 2, rel=0.1)


def test_cost_without_depth() -> None:
    depth = np.full((120, 160), 1.0, np.float32)
    depth[:, 60:100] = 0
    assert cost_of(dataclasses.replace(wall(), depth=depth), (0, 0, 0)) == COST_OUT_OF_VIEW


def test_the_position_of_a_red_patch() -> None:
    frames = []
    for column in (30, 90):
        frame = wall(grey=90)
        color, depth = frame.color.copy(), frame.depth.copy()
        color[50:70, column : column + 24] = (200, 30, 30)
        depth[50:70, column : column + 24] = 0.8
        frames.append(RgbdFrame(color, depth, CAMERA))
    both = search_likelihood(*frames)
    points = geometry.back_project(frames[1].depth, CAMERA)[50:70, 90:114].reshape(-1, 3)
    appearance = both.curr_appearance[50:70, 90:114].reshape(-1, 3)
    positions = propose_positions(both, points, appearance, 30)
    true = points.mean(axis=0) - [60 / 120 * 0.8, 0, 0]
    assert np.linalg.norm(positions[0] - true) < 0.02
    np.testing.assert_array_equal(propose_positions(both, points, appearance, 1), positions[:1])
    assert propose_positions(both, points, appearance, 0).shape == (0, 3)


def disturbed(obj: ObjectMotion, degrees: float, shift: tuple[float, float, float]) -> ObjectMotion:
    """The object with a motion that is off by a rotation about its position and a shift in metres."""
    position = geometry.transform(obj.prev_T_curr, obj.center)
    R = Rotation.from_rotvec(np.radians(degrees) * np.array([0.6, 0.0, 0.8])).as_matrix()
    wrong = geometry.make_transform(R, position - R @ position + shift)
    return dataclasses.replace(obj, prev_T_curr=wrong @ obj.prev_T_curr)


def error(scene: analytic.AnalyticPair, obj: ObjectMotion) -> float:
    """Mean error in metres of the object's pixels against the exact flow."""
    mask = scene.labels == obj.id
    points = geometry.back_project(scene.curr.depth, scene.curr.camera)[mask].astype(np.float64)
    return float(
        np.linalg.norm(geometry.transform(obj.prev_T_curr, points) - points - scene.scene_flow[mask], axis=1).mean()
    )


def search(
    scene: analytic.AnalyticPair, objects: tuple[ObjectMotion, ...], settings: PostprocessSettings = DEFAULTS
) -> tuple[ObjectMotion, ...]:
    labels, found = search_motions(FramePair(scene.prev, scene.curr), scene.labels, objects, settings)
    assert labels is scene.labels
    return found


def test_wrong_motions_are_replaced() -> None:
    """From 5 cm and 30 degrees off, nearly every object that `prev` shows is found to within 1 cm."""
    before, after = [], []
    for seed in range(61, 67):
        scene = analytic.make_scene(seed, objects=(3, 5), depth_noise=0.0015, max_angle_deg=30)
        start = tuple(disturbed(obj, 30.0, (0.04, -0.02, 0.02)) if obj.moving else obj for obj in true_objects(scene))
        found = search(scene, start)
        assert [(one.id, one.score, one.pixels) for one in found] == [(one.id, one.score, one.pixels) for one in start]
        for old, new in zip(start, found, strict=True):
            mask = scene.labels == old.id
            if scene.kinds[old.id] == "box" and old.moving and scene.visible[mask].mean() > 0.7:
                before.append(error(scene, old))
                after.append(error(scene, new))
            if not old.moving:
                assert new is old
    assert len(after) >= 5
    assert min(before) > 0.03
    assert np.mean(np.array(after) < 0.01) >= 0.75


def test_correct_motions_stay() -> None:
    scene = analytic.make_scene(62, objects=(3, 5), depth_noise=0.0015)
    start = true_objects(scene)
    for old, new in zip(start, search(scene, start), strict=True):
        if scene.visible[scene.labels == old.id].mean() > 0.9:
            assert new is old


@pytest.mark.parametrize(
    "settings",
    [
        MotionSearchSettings(max_trusted_cost=100.0),
        MotionSearchSettings(min_cost_reduction=100.0, features=NO_FEATURES),
        MotionSearchSettings(min_inlier_ratio=1.0, features=NO_FEATURES),
        MotionSearchSettings(cost_per_metre=1000.0, features=NO_FEATURES),
        MotionSearchSettings(cost_per_radian=1000.0, features=NO_FEATURES),
        MotionSearchSettings(min_pixels=10**6),
    ],
    ids=lambda settings: str(next(k for k, v in vars(settings).items() if v != vars(MotionSearchSettings())[k])),
)
def test_the_settings_can_forbid_every_replacement(settings: MotionSearchSettings) -> None:
    scene = analytic.make_scene(61, objects=(2, 2), depth_noise=0.0015)
    start = tuple(disturbed(obj, 30.0, (0.04, -0.02, 0.02)) for obj in true_objects(scene))
    assert any(new is not old for old, new in zip(start, search(scene, start), strict=True))
    assert search(scene, start, dataclasses.replace(DEFAULTS, motion_search=settings)) == start


def test_search_levels_need_equally_many_values() -> None:
    more = {"motion_search.levels.kept": "16,12"}
    with pytest.raises(SettingsError, match=r"search levels need equally many values each, not angles_deg 1.*kept 2"):
        build(PostprocessSettings, more)
    names = ("angles_deg", "shifts", "perturbed", "kept", "depth_scales", "color_scales")
    levels = vars(SearchLevelSettings())
    two = {f"motion_search.levels.{name}": levels[name] * 2 for name in names}
    assert build(PostprocessSettings, two).motion_search.levels.kept == (96, 96)


@pytest.mark.parametrize("name", ["judged.iterations", "last_iterations"])
def test_registration_has_two_blurs(name: str) -> None:
    with pytest.raises(SettingsError, match=rf"motion_search\.{name} takes at most 2 values, not 3"):
        build(PostprocessSettings, {f"motion_search.{name}": "4,4,4"})


def test_an_object_that_the_previous_frame_does_not_show_keeps_its_motion() -> None:
    scene = analytic.make_scene(63, objects=(1, 1), motion=(0.05, 0.1))
    (obj,) = true_objects(scene)
    depth, color = scene.prev.depth.copy(), scene.prev.color.copy()
    gone = scene.prev_labels == obj.id
    depth[gone] = depth[~gone].max()
    color[gone] = 0
    scene = dataclasses.replace(scene, prev=dataclasses.replace(scene.prev, depth=depth, color=color))
    start = (disturbed(obj, 20.0, (0.05, 0.0, 0.0)),)
    assert search(scene, start) == start


def test_large_rotations_are_found() -> None:
    """Motions that are off by 70 degrees about the object's centre."""
    after = []
    for seed in range(61, 69):
        scene = analytic.make_scene(seed, objects=(3, 5), depth_noise=0.0015, max_angle_deg=30)
        start = tuple(disturbed(obj, 70.0, (0.03, 0.02, 0.0)) if obj.moving else obj for obj in true_objects(scene))
        for old, new in zip(start, search(scene, start), strict=True):
            mask = scene.labels == old.id
            if scene.kinds[old.id] == "box" and old.moving and scene.visible[mask].mean() > 0.7 and mask.sum() > 400:
                after.append(error(scene, new))
    assert len(after) >= 15
    assert np.mean(np.array(after) < 0.002) >= 0.9


def test_the_search_is_deterministic() -> None:
    scene = analytic.make_scene(61, objects=(3, 3), depth_noise=0.0015)
    start = tuple(disturbed(obj, 30.0, (0.04, 0.0, 0.0)) for obj in true_objects(scene))
    once, again = search(scene, start), search(scene, start)
    for a, b in zip(once, again, strict=True):
        np.testing.assert_array_equal(a.prev_T_curr, b.prev_T_curr)
