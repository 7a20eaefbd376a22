"""The training-free estimator on analytic scenes with known motions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment

import analytic
import objectflow
from objectflow import RgbdFrame, SceneMotion, geometry
from objectflow.alignment.frame_pair import FramePair
from objectflow.errors import MethodError, SettingsError
from objectflow.methods.consensus.estimator import ConsensusEstimator
from objectflow.typing import BoolMask, Float64Array

SEEDS = range(100, 108)


@dataclass(frozen=True)
class Scored:
    pair: analytic.AnalyticPair
    motion: SceneMotion
    dense_flow: SceneMotion


def f_score(mask: BoolMask, truth: BoolMask) -> float:
    return 2.0 * float((mask & truth).sum()) / float(mask.sum() + truth.sum())


def match_objects(pair: analytic.AnalyticPair, motion: SceneMotion) -> list[tuple[int, int | None, float]]:
    """(true label, found id or None, F-measure) of each visible moving object, by optimal assignment."""
    true = [label for label in sorted(pair.moving) if (pair.labels == label).any()]
    table = np.array(
        [[f_score(motion.labels == o.id, pair.labels == label) for o in motion.objects] for label in true]
    )
    table = table.reshape(len(true), len(motion.objects))
    rows, columns = linear_sum_assignment(-table)
    found = {true[r]: (motion.objects[c].id, float(table[r, c])) for r, c in zip(rows, columns, strict=True)}
    return [(label, *found.get(label, (None, 0.0))) for label in true]


def masked_epe(pair: analytic.AnalyticPair, motion: SceneMotion) -> float:
    in_both = [label for label in pair.prev_T_curr if (pair.prev_labels == label).any()]
    mask = np.isin(pair.labels, in_both) & np.isfinite(pair.scene_flow[..., 2])
    return float(np.linalg.norm((motion.scene_flow - pair.scene_flow)[mask], axis=-1).mean())


@pytest.fixture(scope="module")
def scored() -> list[Scored]:
    consensus, dense = objectflow.load("consensus"), objectflow.load("dense-flow")
    pairs = [analytic.make_scene(seed) for seed in SEEDS]
    return [Scored(pair, consensus(pair.prev, pair.curr), dense(pair.prev, pair.curr)) for pair in pairs]


def test_the_error_is_at_most_half_that_of_dense_flow(scored: list[Scored]) -> None:
    ours = np.mean([masked_epe(s.pair, s.motion) for s in scored])
    theirs = np.mean([masked_epe(s.pair, s.dense_flow) for s in scored])
    assert ours <= 0.5 * theirs


def test_most_objects_are_found_with_at_most_one_false_one(scored: list[Scored]) -> None:
    matches = [match for s in scored for match in match_objects(s.pair, s.motion)]
    assert np.mean([f >= 0.75 for _, _, f in matches]) >= 0.85
    surplus = sum(len(s.motion.objects) for s in scored) - sum(identifier is not None for _, identifier, _ in matches)
    assert surplus <= 1


def test_found_objects_have_the_true_motion(scored: list[Scored]) -> None:
    errors = []
    for s in scored:
        by_id = {obj.id: obj for obj in s.motion.objects}
        for label, identifier, f in match_objects(s.pair, s.motion):
            if identifier is not None and f >= 0.75:
                true, center = s.pair.prev_T_curr[label], s.pair.centers[label]
                found = by_id[identifier].prev_T_curr
                errors.append(np.linalg.norm(geometry.transform(found, center) - geometry.transform(true, center)))
    assert np.median(errors) < 0.002


def test_the_background_flow_of_a_static_camera_is_exactly_zero(scored: list[Scored]) -> None:
    for s in scored:
        background = (s.motion.labels == 0) & s.pair.curr.valid
        assert s.motion.camera_motion is None
        assert not s.motion.scene_flow[background].any()


def test_the_flow_follows_from_the_reported_motions(scored: list[Scored]) -> None:
    for s in scored[:3]:
        points = geometry.back_project(s.pair.curr.depth, s.pair.curr.camera)
        for obj in s.motion.objects:
            mask = (s.motion.labels == obj.id) & s.pair.curr.valid
            moved = geometry.transform(obj.prev_T_curr, points[mask].astype(np.float64)) - points[mask]
            np.testing.assert_allclose(s.motion.scene_flow[mask], moved, atol=1e-6)


def test_nothing_moves_in_a_static_scene() -> None:
    pair = analytic.make_scene(5, moving_share=0.0)
    motion = objectflow.load("consensus")(pair.prev, pair.curr)
    assert motion.objects == ()
    assert motion.camera_motion is None
    assert not motion.labels.any()


def test_only_the_moving_objects_among_static_ones_are_found() -> None:
    pair = analytic.make_scene(17, objects=(4, 6), moving_share=0.4)
    motion = objectflow.load("consensus")(pair.prev, pair.curr)
    matches = match_objects(pair, motion)
    assert 0 < len(matches) < len(pair.prev_T_curr)
    assert len(motion.objects) == len(matches)
    assert all(f >= 0.75 for _, _, f in matches)


def test_a_moving_camera_is_detected_and_measured() -> None:
    curr_T_prev = geometry.se3_exp([0.02, -0.01, 0.015, 0.01, 0.03, -0.02])
    pair = analytic.make_scene(3, camera_motion=curr_T_prev)
    motion = objectflow.load("consensus", camera="auto")(pair.prev, pair.curr)
    assert motion.camera_motion is not None
    error = geometry.inverse(pair.camera_motion) @ motion.camera_motion
    assert np.linalg.norm(error[:3, 3]) < 0.001
    assert np.degrees(geometry.rotation_angle(error[:3, :3])) < 0.1
    assert all(f >= 0.75 for _, _, f in match_objects(pair, motion))


def test_noisy_depth_gives_at_most_one_false_object() -> None:
    pair = analytic.make_scene(9, depth_noise=0.002)
    motion = objectflow.load("consensus")(pair.prev, pair.curr)
    matches = match_objects(pair, motion)
    assert len(motion.objects) <= len(matches) + 1
    assert all(f >= 0.75 for _, _, f in matches)


def test_the_same_input_gives_the_same_result() -> None:
    pair = analytic.make_scene(4, width=160, height=120)
    first, second = (objectflow.load("consensus")(pair.prev, pair.curr) for _ in range(2))
    np.testing.assert_array_equal(first.labels, second.labels)
    np.testing.assert_array_equal(first.scene_flow, second.scene_flow)


def test_a_region_without_a_rigid_motion_has_a_low_score() -> None:
    """A patch of the floor becomes a wavy bump with other colours."""
    pair = analytic.make_scene(9, moving_share=0.0)
    rng = np.random.default_rng(0)
    height, width = pair.curr.depth.shape
    v, u = np.mgrid[0:height, 0:width]
    radius = np.hypot(u - 230, v - 170)
    patch = radius < 30
    depth, color = pair.curr.depth.copy(), pair.curr.color.copy()
    depth[patch] -= (0.03 + 0.02 * np.sin(u / 3.0)[patch]).astype(np.float32)
    color[patch] = rng.integers(0, 255, (int(patch.sum()), 3), np.uint8)
    curr = RgbdFrame(color=color, depth=depth, camera=pair.curr.camera)
    motion = objectflow.load("consensus")(pair.prev, curr)
    assert 1 <= len(motion.objects) <= 2
    assert f_score(motion.labels > 0, patch) > 0.6
    assert max(obj.score for obj in motion.objects) < 0.5


@pytest.mark.parametrize("size", [(64, 48), (161, 121), (640, 360)])
def test_results_lie_on_the_pixels_of_any_resolution(size: tuple[int, int]) -> None:
    pair = analytic.make_scene(4, width=320, height=240)
    prev, curr = pair.prev.resized(*size), pair.curr.resized(*size)
    motion = objectflow.load("consensus")(prev, curr)
    assert motion.labels.shape == (size[1], size[0])
    assert np.isnan(motion.scene_flow[..., 2]).sum() == (~curr.valid).sum()


def test_frames_without_texture_or_overlap_do_not_crash() -> None:
    pair = analytic.make_scene(4, width=160, height=120)
    plain = RgbdFrame(np.full_like(pair.curr.color, 128), np.full_like(pair.curr.depth, 0.7), pair.curr.camera)
    few = np.zeros_like(pair.curr.depth)
    few[50:54, 50:54] = 0.5
    sparse = RgbdFrame(pair.curr.color, few, pair.curr.camera)
    cameras = []
    for prev, curr in (
        (plain, plain),
        (plain, pair.curr),
        (pair.prev, plain),
        (sparse, pair.curr),
        (pair.prev, sparse),
    ):
        motion = objectflow.load("consensus")(prev, curr)
        if motion.camera == "unknown":
            assert np.isnan(motion.scene_flow).all()
            assert motion.objects == ()
            assert not motion.labels.any()
            assert motion.notes[0].startswith("camera: unknown: ")
        else:
            assert np.isfinite(motion.scene_flow[curr.valid]).all()
        cameras.append(motion.camera)
    # Nothing contradicts a static camera before a plain wall, or where the frames share no depth.
    assert cameras[:3] == ["static", "unknown", "unknown"]


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"camera": "handheld"}, "setting camera must be one of auto, static, moving, not 'handheld'"),
        ({"speed": 3}, "unknown setting speed: did you mean seed"),
        ({"selection.min_gain": "x"}, "setting selection.min_gain must be a finite number, not 'x'"),
        ({"rounds": 0}, "setting rounds must be at least 1, not 0"),
        ({"min_object_share": 1}, "setting min_object_share must be above 0 and below 1, not 1"),
        ({"depth_noise": "sonar"}, "setting depth_noise must be one of structured-light, time-of-flight, stereo, "),
    ],
)
def test_invalid_settings_are_rejected(settings: dict[str, object], message: str) -> None:
    with pytest.raises(SettingsError) as caught:
        objectflow.load("consensus", **settings)
    assert str(caught.value).startswith(message)


def test_unknown_methods_are_rejected() -> None:
    with pytest.raises(MethodError, match="choose one of consensus, dense-flow"):
        objectflow.load("magic")


def painted(frame: RgbdFrame, center: Float64Array, axes: Float64Array, *, shadow: bool) -> RgbdFrame:
    """The frame with a 12 cm square on the floor: a flat coloured print, or a shadow."""
    offset = geometry.back_project(frame.depth, frame.camera) - center
    s, t = offset @ axes[0], offset @ axes[1]
    with np.errstate(invalid="ignore"):
        inside = (np.abs(s) < 0.06) & (np.abs(t) < 0.06)
    color = frame.color.copy()
    if shadow:
        color[inside] = (0.55 * color[inside]).astype(np.uint8)
    else:
        rings = np.sin(np.hypot(s, t) * 250) + np.sin(s * 180) > 0
        color[inside] = np.where(rings[inside, None], (220, 40, 30), (250, 220, 60))
    return RgbdFrame(color=color, depth=frame.depth, camera=frame.camera)


@pytest.mark.parametrize("shadow", [False, True])
def test_a_sliding_flat_print_is_found_and_a_shadow_is_not(shadow: bool) -> None:
    pair = analytic.make_scene(9, moving_share=0.0)
    points = geometry.back_project(pair.prev.depth, pair.prev.camera).astype(np.float64)
    floor = points[(pair.prev_labels == 0) & (points[..., 2] < np.median(points[..., 2]))]
    center = floor[np.argmin(np.linalg.norm(floor - floor.mean(axis=0), axis=1))]
    _, _, axes = np.linalg.svd(floor[::50] - floor.mean(axis=0), full_matrices=False)
    slide = 0.04 * axes[0]
    prev = painted(pair.prev, center, axes, shadow=shadow)
    curr = painted(RgbdFrame(pair.prev.color, pair.prev.depth, pair.prev.camera), center + slide, axes, shadow=shadow)
    motion = objectflow.load("consensus")(prev, curr)
    if shadow:
        assert motion.objects == ()
    else:
        assert len(motion.objects) == 1
        np.testing.assert_allclose(motion.objects[0].translation, -slide, atol=0.002)


# --- settings and prepared pairs ---


def test_results_name_the_settings_that_made_them() -> None:
    scene = analytic.make_scene(4, width=160, height=120)
    motion = objectflow.load("consensus", camera="static", **{"selection.min_gain": 0.5})(scene.prev, scene.curr)
    assert motion.settings["camera"] == "static"
    assert motion.settings["selection"]["min_gain"] == 0.5
    assert objectflow.load("consensus", **motion.settings).to_dict() == motion.settings  # type: ignore[attr-defined]


def test_a_prepared_pair_gives_the_same_result_and_stays_as_it_is() -> None:
    scene, estimator = analytic.make_scene(4, width=160, height=120), ConsensusEstimator()
    pair = FramePair(scene.prev, scene.curr)
    expected = estimator(scene.prev, scene.curr)
    for _ in range(2):
        found = estimator.estimate(pair)
        np.testing.assert_array_equal(found.labels, expected.labels)
        np.testing.assert_array_equal(found.scene_flow, expected.scene_flow)
    assert "matches" in pair.__dict__


@pytest.mark.parametrize(
    "settings",
    [{"selection.min_gain": 100.0}, {"selection.min_total_gain": 1e9}, {"min_object_share": 0.5}],
    ids=lambda settings: next(iter(settings)),
)
def test_the_settings_can_reject_every_object(settings: dict[str, float]) -> None:
    scene = analytic.make_scene(100, width=160, height=120)
    assert objectflow.load("consensus")(scene.prev, scene.curr).objects
    settings |= {"selection.max_unexplained": 0}
    assert not objectflow.load("consensus", **settings)(scene.prev, scene.curr).objects


def with_correlated_noise(frame: RgbdFrame, sigma: float, rng: np.random.Generator) -> RgbdFrame:
    """The frame with depth noise of `sigma` metres at 1 m, constant over blocks of 16x16 pixels, as of stereo."""
    blocks = np.kron(rng.standard_normal((15, 20)), np.ones((16, 16)))
    return RgbdFrame(frame.color, (frame.depth + sigma * frame.depth**2 * blocks).astype(np.float32), frame.camera)


def test_noisy_depth_needs_its_noise_model() -> None:
    """The model of a structured-light camera takes a stereo camera's noise for motion."""
    scene, rng = analytic.make_scene(9, moving_share=0.0), np.random.default_rng(9)
    pair = FramePair(*(with_correlated_noise(frame, 0.01, rng) for frame in (scene.prev, scene.curr)))
    count = {
        name: len(objectflow.load("consensus", camera="static", depth_noise=name).estimate(pair).objects)
        for name in ("structured-light", "stereo", "measured")
    }
    assert count["structured-light"] >= 10
    assert count["stereo"] <= 0.5 * count["structured-light"]
    assert count["measured"] <= 0.1 * count["structured-light"]
