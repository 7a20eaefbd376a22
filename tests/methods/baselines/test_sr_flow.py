"""SR-Flow on analytic scenes with small motions, and against the output of the VO-SF authors' program."""

from __future__ import annotations

import dataclasses
from functools import cache
from typing import Any

import numpy as np
import pytest
import torch

import analytic
import objectflow
from helpers.paths import SHARED
from objectflow import Camera, RgbdFrame, geometry
from objectflow.errors import MethodError
from objectflow.methods.baselines.sr_flow.estimator import SRFlow, frame_tensors
from objectflow.typing import Float32Array

QUICK: dict[str, Any] = {"levels": 2, "alternations": 2, "steps": 2, "smoothing_steps": 10}


@cache
def scene(seed: int, width: int = 160) -> analytic.AnalyticPair:
    return analytic.make_scene(
        seed, objects=(2, 4), motion=(0.003, 0.008), max_angle_deg=3, width=width, height=width * 3 // 4
    )


def lengths(flow: Float32Array) -> Float32Array:
    return np.asarray(np.linalg.norm(flow, axis=-1))


def test_the_error_of_small_motions_is_below_a_third() -> None:
    errors, zero, static = [], [], []
    for seed in (1, 4):
        pair = scene(seed)
        flow = SRFlow()(pair.prev, pair.curr).scene_flow
        visible = pair.visible & pair.curr.valid
        moving = visible & np.isin(pair.labels, list(pair.moving))
        errors.append(lengths(flow - pair.scene_flow)[moving])
        zero.append(lengths(pair.scene_flow)[moving])
        static.append(lengths(flow)[visible & (pair.labels == 0)])
    assert np.concatenate(zero).max() < 0.01
    assert np.concatenate(errors).mean() < np.concatenate(zero).mean() / 3
    assert np.median(np.concatenate(static)) < 1e-4


def test_the_energy_decreases_at_every_alternation() -> None:
    pair = scene(0, width=80)
    for alpha in (1.0, 10.0):
        solution = SRFlow(alpha=alpha).solve(pair.prev, pair.curr)
        assert [len(energies) for energies in solution.energies] == [6, 6, 6]
        for energies in solution.energies:
            values = torch.stack(energies)[:, 0].double().numpy()
            assert (np.diff(values) < 1e-6 * values[0]).all()
        finest = torch.stack(solution.energies[-1])[:, 0]
        assert float(finest[-1]) < 0.9 * float(finest[0])


def test_the_camera_motion_is_estimated_and_compensated() -> None:
    camera_motion = geometry.se3_exp([0.01, -0.005, 0.004, 0.01, 0.02, -0.01])
    pair = analytic.make_scene(
        0, objects=(2, 4), motion=(0.003, 0.008), max_angle_deg=3, width=160, height=120, camera_motion=camera_motion
    )
    moving = pair.visible & pair.curr.valid & np.isin(pair.labels, list(pair.moving))
    rigid = SRFlow(mode="rigid")(pair.prev, pair.curr)
    semi_rigid = SRFlow(camera="moving")(pair.prev, pair.curr)
    for motion in (rigid, semi_rigid):
        assert motion.camera_motion is not None
        error = geometry.se3_log(motion.camera_motion @ geometry.inverse(camera_motion))
        assert np.linalg.norm(error[:3]) < 0.0005
        assert np.linalg.norm(error[3:]) < 0.0005
    # In rigid mode the flow is that of the camera motion.
    expected = geometry.flow_from_motions(
        geometry.back_project(pair.curr.depth, pair.curr.camera), pair.labels * 0, {}, rigid.camera_motion
    )
    np.testing.assert_allclose(rigid.scene_flow, expected, atol=1e-5)
    rigid_error, semi_rigid_error = (
        lengths(motion.scene_flow - pair.scene_flow)[moving].mean() for motion in (rigid, semi_rigid)
    )
    assert semi_rigid_error < 0.5 * rigid_error
    assert SRFlow(mode="non-rigid", camera="moving", **QUICK)(pair.prev, pair.curr).camera_motion is None


def test_a_batch_gives_the_same_solution_as_single_pairs() -> None:
    method = SRFlow(mode="semi-rigid", rigid_steps=5, **QUICK)
    pairs = [scene(0), scene(1)]
    inputs = [[frame_tensors(frame, torch.device("cpu")) for frame in (pair.curr, pair.prev)] for pair in pairs]
    intrinsics = torch.stack([objectflow.geometry.torch_pinhole.intrinsics(pair.curr.camera) for pair in pairs])
    frames = [tuple(torch.cat([item[k][i] for item in inputs]) for i in range(2)) for k in range(2)]
    batch = method.solve_tensors((frames[0][0], frames[0][1]), (frames[1][0], frames[1][1]), intrinsics)
    for k, (curr, prev) in enumerate(inputs):
        single = method.solve_tensors(curr, prev, intrinsics[k : k + 1])
        # Where energies are equal up to rounding, a pixel's step may be accepted in only one of the runs.
        assert float((batch.twist[k] - single.twist[0]).abs().mean()) < 1e-6
        torch.testing.assert_close(batch.motion[k], single.motion[0], atol=1e-5, rtol=0)


@pytest.mark.parametrize(("width", "height"), [(1, 1), (2, 3), (9, 7), (40, 30), (400, 20)])
def test_images_of_any_size_give_flow_at_full_resolution(width: int, height: int) -> None:
    rng = np.random.default_rng(0)
    camera = Camera(width, height, width, width, (width - 1) / 2, (height - 1) / 2)
    color = rng.integers(0, 256, (height, width, 3)).astype(np.uint8)
    depth = np.full((height, width), 0.8, np.float32)
    depth[0, 1:] = 0
    frame = RgbdFrame(color, depth, camera)
    motion = SRFlow(**QUICK)(frame, frame)
    np.testing.assert_array_equal(np.isnan(motion.scene_flow).all(-1), depth == 0)
    np.testing.assert_array_equal(np.isnan(motion.scene_flow).any(-1), depth == 0)
    assert np.nanmax(np.abs(motion.scene_flow)) < 1e-4
    assert (motion.method, motion.objects) == ("sr-flow", ())
    assert (motion.labels == 0).all()


def test_flow_is_nan_exactly_where_depth_is_missing() -> None:
    pair = scene(0)
    prev, curr = (f.depth.copy() for f in (pair.prev, pair.curr))
    prev[10:30, 40:60], curr[50:70, 20:90], curr[::13, ::7] = 0, 0, 0
    frames = dataclasses.replace(pair.prev, depth=prev), dataclasses.replace(pair.curr, depth=curr)
    motion = SRFlow(**QUICK)(*frames)
    np.testing.assert_array_equal(np.isnan(motion.scene_flow).any(-1), curr == 0)
    assert np.nanmax(np.abs(motion.scene_flow)) < 0.1


def test_a_pair_without_common_depth_has_no_flow() -> None:
    camera = Camera(64, 48, 60.0, 60.0, 31.5, 23.5)
    color = np.full((48, 64, 3), 128, np.uint8)
    left, right = np.zeros((48, 64), np.float32), np.zeros((48, 64), np.float32)
    left[:, :5], right[:, -5:] = 1, 1
    for mode in ("non-rigid", "rigid", "semi-rigid"):
        motion = SRFlow(mode=mode, **QUICK)(RgbdFrame(color, left, camera), RgbdFrame(color, right, camera))
        assert float(np.abs(motion.scene_flow[right > 0]).max()) < 1e-3


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"mode": "flexible"}, "mode must be one of auto, non-rigid, rigid, semi-rigid, not 'flexible'"),
        ({"levels": 0}, "levels must be at least 1, not 0"),
        ({"steps": 2.5}, "steps must be .*, not 2.5"),
        ({"alpha": -1.0}, "alpha must be above 0 .*, not -1"),
        ({"kappa": float("nan")}, "kappa must be a finite number, not nan"),
        ({"device": "abacus"}, "abacus"),
    ],
)
def test_invalid_options_are_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(MethodError, match=message):
        objectflow.load("sr-flow", **options)


@pytest.mark.skipif(not (SHARED / "reference" / "vosf" / "robot").is_dir(), reason=f"no reference output in {SHARED}")
def test_the_flow_of_the_robot_agrees_with_the_authors_vo_sf() -> None:
    folder, reference = SHARED / "data" / "robot", SHARED / "reference" / "vosf" / "robot"
    camera, scale = Camera.read(folder / "camera.json")
    first, second = (
        RgbdFrame.read(
            next(folder.glob(f"color{k}.*")), folder / f"depth{k}.png", camera=camera, depth_scale=scale or 1000
        ).resized(320, 240)
        for k in (0, 1)
    )
    expected = np.load(reference / "flow.npy").transpose(1, 2, 0)
    labels, moving = np.load(reference / "labels.npy"), np.append(np.load(reference / "b.npy"), 0) > 0.667
    robot = moving[labels.astype(int)] & first.valid
    assert robot.sum() > 5000
    flow = SRFlow(alternations=2)(second, first).scene_flow[robot]
    cosine = (flow * expected[robot]).sum(-1) / np.maximum(lengths(flow) * lengths(expected[robot]), 1e-12)
    assert np.degrees(np.arccos(np.clip(np.median(cosine), -1, 1))) < 20
    assert np.median(lengths(flow - expected[robot])) < 0.3 * np.median(lengths(expected[robot]))
