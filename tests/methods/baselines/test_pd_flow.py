"""`pd-flow` on scenes with known motion, against the VO-SF authors' output, and on edge-case inputs."""

from __future__ import annotations

import dataclasses
from functools import cache

import numpy as np
import pytest
import torch

import analytic
import objectflow
from helpers.authors_program import DATA, PROGRAM, needs_program, vo_sf_program
from helpers.odd_inputs import TINY_SIZES, nearly_without_depth, random_pair, with_holes
from objectflow import RgbdFrame
from objectflow.alignment.appearance import to_gray
from objectflow.errors import FrameError, MethodError
from objectflow.geometry import torch_pinhole
from objectflow.methods.baselines.pd_flow.estimator import estimate
from objectflow.methods.baselines.pd_flow.pyramid import Images


@cache
def scene(seed: int) -> analytic.AnalyticPair:
    """A scene with displacements below 1 cm."""
    return analytic.make_scene(seed, objects=(2, 4), motion=(0.003, 0.008), max_angle_deg=3)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_small_smooth_motion_is_estimated(seed: int) -> None:
    pair = scene(seed)
    motion = objectflow.load("pd-flow", device="cpu")(pair.prev, pair.curr)
    moving = np.isin(pair.labels, list(pair.moving))
    error = np.linalg.norm(motion.scene_flow - pair.scene_flow, axis=-1)
    moved = np.linalg.norm(pair.scene_flow, axis=-1)
    assert moved.max() < 0.012
    # The error of zero flow is the motion itself.
    assert error[moving].mean() < moved[moving].mean() / 3
    assert error.mean() < moved.mean() / 3
    assert (motion.labels == 0).all()
    assert motion.objects == ()


@needs_program
def test_the_flow_of_the_robot_agrees_with_the_authors_vo_sf() -> None:
    prev, curr = vo_sf_program.read_pair(DATA / "robot")
    output = vo_sf_program.read_output(PROGRAM / "robot")
    motion = objectflow.load("pd-flow", device="cpu")(prev, curr)
    assert vo_sf_program.compare(motion, output)["angle deg"] < 20
    length, reference = (np.linalg.norm(flow[output.moving], axis=-1) for flow in (motion.scene_flow, output.flow))
    assert 0.8 < np.median(length) / np.median(reference) < 1.25


def images(frames: list[RgbdFrame], device: str = "cpu") -> Images:
    return Images(
        torch.stack([torch.from_numpy(to_gray(f.color)).float()[None] for f in frames]).to(device),
        torch.stack([torch.from_numpy(f.depth)[None] for f in frames]).to(device),
        torch.stack([torch_pinhole.intrinsics(f.camera) for f in frames]).to(device),
    )


def test_a_batch_gives_the_same_flow_as_single_pairs() -> None:
    small = [scene(k) for k in (0, 1)]
    prev, curr = ([getattr(pair, name).resized(160, 128) for pair in small] for name in ("prev", "curr"))
    batch = estimate(images(curr), images(prev))
    for k in (0, 1):
        single = estimate(images(curr[k : k + 1]), images(prev[k : k + 1]))
        np.testing.assert_allclose(batch[k], single[0], atol=2e-3)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_cuda_agrees_with_the_cpu() -> None:
    pair = scene(0)
    cpu = estimate(images([pair.curr]), images([pair.prev]))
    cuda = estimate(images([pair.curr], "cuda"), images([pair.prev], "cuda")).cpu()
    assert (cpu - cuda).abs().median() < 1e-4
    assert torch.quantile((cpu - cuda).abs().flatten()[::7], 0.99) < 0.02


def test_a_larger_image_gives_the_same_motion() -> None:
    pair = analytic.make_scene(0, objects=(2, 4), motion=(0.003, 0.008), max_angle_deg=3, width=640, height=480)
    motion = objectflow.load("pd-flow", device="cpu")(pair.prev, pair.curr)
    moving = np.isin(pair.labels, list(pair.moving))
    error = np.linalg.norm(motion.scene_flow - pair.scene_flow, axis=-1)[moving]
    assert error.mean() < np.linalg.norm(pair.scene_flow, axis=-1)[moving].mean() / 3


def test_identical_frames_have_no_flow() -> None:
    frame = scene(0).curr
    motion = objectflow.load("pd-flow", device="cpu")(frame, frame)
    assert np.abs(motion.scene_flow).max() < 1e-6


def test_flow_is_nan_exactly_where_depth_is_missing() -> None:
    pair = scene(0)
    prev, curr = with_holes(pair.prev, pair.curr)
    motion = objectflow.load("pd-flow")(prev, curr)
    np.testing.assert_array_equal(np.isnan(motion.scene_flow).all(-1), ~curr.valid)
    np.testing.assert_array_equal(np.isnan(motion.scene_flow).any(-1), ~curr.valid)


@pytest.mark.parametrize("size", TINY_SIZES)
def test_tiny_images_work(size: tuple[int, int]) -> None:
    width, height = size
    motion = objectflow.load("pd-flow", camera="static")(*random_pair(size))
    assert motion.scene_flow.shape == (height, width, 3)
    assert np.isfinite(motion.scene_flow).all()


def test_implausible_depth_is_ignored() -> None:
    frame = scene(0).curr
    depth = frame.depth.copy()
    depth[:50], depth[60] = 1e30, 1e-30
    implausible = dataclasses.replace(frame, depth=depth)
    flow = objectflow.load("pd-flow")(implausible, implausible).scene_flow
    assert np.abs(flow[70:]).max() < 1e-6


def test_missing_devices_are_refused() -> None:
    with pytest.raises(MethodError, match="device"):
        objectflow.load("pd-flow", device="abacus")
    with pytest.raises(MethodError, match="device"):
        objectflow.load("pd-flow", device="cuda:99")


def test_frames_without_depth_at_the_working_size_are_refused() -> None:
    frame = nearly_without_depth()
    with pytest.raises(FrameError, match="depth"):
        objectflow.load("pd-flow")(frame, frame)
