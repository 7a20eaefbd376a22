"""`vo-sf` against the authors' program, on scenes with known motion, and on edge-case inputs."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

import analytic
import objectflow
from helpers.authors_program import DATA, PROGRAM, needs_program, vo_sf_program
from helpers.odd_inputs import TINY_SIZES, nearly_without_depth, random_pair, with_holes
from objectflow import Camera, RgbdFrame, SceneMotion, geometry
from objectflow.errors import FrameError

# --- the authors' program ---


@needs_program
@pytest.mark.parametrize("name", vo_sf_program.PAIRS)
def test_results_agree_with_the_authors_program(name: str) -> None:
    prev, curr = vo_sf_program.read_pair(DATA / name)
    motion = objectflow.load("vo-sf", camera="moving")(prev, curr)
    difference = vo_sf_program.compare(motion, vo_sf_program.read_output(PROGRAM / name))
    assert difference["iou"] >= 0.85
    assert difference["flow mm"] < 2
    assert difference["camera mm"] < 1
    assert difference["camera deg"] < 0.1


# --- scenes with known motion ---


@cache
def scene() -> analytic.AnalyticPair:
    return analytic.make_scene(4, objects=(1, 2))


@cache
def estimate(camera: str = "static") -> SceneMotion:
    return objectflow.load("vo-sf", camera=camera)(scene().prev, scene().curr)


def test_a_large_object_is_segmented_with_its_motion() -> None:
    truth = np.isin(scene().labels, list(scene().moving))
    motion = estimate()
    assert len(motion.objects) == 1
    mask = motion.labels > 0
    assert (mask & truth).sum() / (mask | truth).sum() > 0.5
    error = np.linalg.norm(motion.scene_flow - scene().scene_flow, axis=-1)[truth]
    assert error.mean() < 0.1 * np.linalg.norm(scene().scene_flow, axis=-1)[truth].mean()
    obj = motion.objects[0]
    assert obj.pixels == mask.sum()
    assert 1 / 3 < obj.score <= 1
    # The rigid fit moves the centre by the mean flow.
    np.testing.assert_allclose(obj.translation, motion.scene_flow[mask].mean(0), atol=1e-5)


def test_the_flow_of_static_clusters_is_exactly_zero_for_a_static_camera() -> None:
    motion = estimate()
    assert motion.camera_motion is None
    assert (motion.scene_flow == 0).all(-1).mean() > 0.5
    assert (motion.scene_flow[motion.labels > 0] != 0).any(-1).all()


def test_auto_detects_a_static_camera() -> None:
    motion = estimate("auto")
    assert motion.camera_motion is None
    np.testing.assert_array_equal(motion.scene_flow, estimate().scene_flow)


@pytest.mark.parametrize("camera", ["auto", "moving"])
def test_the_camera_motion_is_estimated(camera: str) -> None:
    true = geometry.se3_exp([0.008, -0.005, 0.01, 0.01, -0.015, 0.005])
    pair = analytic.make_scene(3, objects=(1, 2), moving_share=0, camera_motion=true)
    motion = objectflow.load("vo-sf", camera=camera)(pair.prev, pair.curr)
    assert motion.camera_motion is not None
    difference = motion.camera_motion @ geometry.inverse(true)
    assert np.degrees(geometry.rotation_angle(difference[:3, :3])) < 0.1
    moved = np.linalg.norm(pair.scene_flow, axis=-1)
    error = np.linalg.norm(motion.scene_flow - pair.scene_flow, axis=-1)
    assert error.mean() < 0.1 * moved.mean()


# --- edge-case inputs ---


def test_the_same_pair_gives_the_same_result() -> None:
    again = objectflow.load("vo-sf", camera="static")(scene().prev, scene().curr)
    np.testing.assert_array_equal(again.scene_flow, estimate().scene_flow)
    np.testing.assert_array_equal(again.labels, estimate().labels)


def test_a_larger_image_gives_the_same_motion_at_full_resolution() -> None:
    large = analytic.make_scene(4, objects=(1, 2), width=640, height=480)
    motion = objectflow.load("vo-sf", camera="static")(large.prev, large.curr)
    assert motion.labels.shape == (480, 640)
    truth = np.isin(large.labels, list(large.moving))
    error = np.linalg.norm(motion.scene_flow - large.scene_flow, axis=-1)[truth]
    assert error.mean() < 0.15 * np.linalg.norm(large.scene_flow, axis=-1)[truth].mean()
    # Labels are computed per pixel, not upsampled in blocks.
    assert (motion.labels[::2] != motion.labels[1::2]).any()
    assert (motion.labels[:, ::2] != motion.labels[:, 1::2]).any()


def test_flow_is_nan_exactly_where_depth_is_missing() -> None:
    pair = scene()
    prev, curr = with_holes(pair.prev, pair.curr)
    motion = objectflow.load("vo-sf")(prev, curr)
    np.testing.assert_array_equal(np.isnan(motion.scene_flow).all(-1), ~curr.valid)
    assert (motion.labels[~curr.valid] == 0).all()


@pytest.mark.parametrize("size", TINY_SIZES)
def test_tiny_images_work(size: tuple[int, int]) -> None:
    width, height = size
    motion = objectflow.load("vo-sf")(*random_pair(size))
    assert motion.scene_flow.shape == (height, width, 3)
    assert np.isfinite(motion.scene_flow).all()


def test_a_single_valid_pixel_suffices_and_implausible_depth_is_ignored() -> None:
    camera, color = Camera(320, 240, 264.0, 264.0, 159.5, 119.5), np.zeros((240, 320, 3), np.uint8)
    single = np.zeros((240, 320), np.float32)
    single[100, 100] = 1
    motion = objectflow.load("vo-sf")(RgbdFrame(color, single, camera), RgbdFrame(color, single, camera))
    assert np.isfinite(motion.scene_flow[100, 100]).all()
    depth = np.ones((240, 320), np.float32)
    depth[:50], depth[60] = 1e30, 1e-30
    motion = objectflow.load("vo-sf")(RgbdFrame(color, depth, camera), RgbdFrame(color, depth, camera))
    assert (motion.scene_flow[70:] == 0).all()
    assert motion.objects == ()


def test_frames_without_depth_at_the_working_size_are_refused() -> None:
    frame = nearly_without_depth()
    with pytest.raises(FrameError, match="depth"):
        objectflow.load("vo-sf")(frame, frame)
