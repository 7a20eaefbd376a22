"""Loading by name, the two plain baselines, and the matches that every method uses."""

from __future__ import annotations

import dataclasses
import importlib
from collections.abc import Iterator, Sequence
from functools import cache

import numpy as np
import pytest

import analytic
import objectflow
from helpers.small_networks import save_all
from objectflow import Camera, RgbdFrame, geometry
from objectflow.alignment import matching
from objectflow.alignment.appearance import to_gray
from objectflow.alignment.frame_pair import FramePair
from objectflow.errors import FrameError, MethodError, SettingsError
from objectflow.methods import find_weights
from objectflow.methods.base import PairEstimator, estimate_pair
from objectflow.methods.registry import find_class
from objectflow.typing import BoolMask, Float32Array, Float64Array


@cache
def scene(seed: int) -> analytic.AnalyticPair:
    return analytic.make_scene(seed, objects=(2, 4), motion=(0.005, 0.015), max_angle_deg=6)


@pytest.fixture(autouse=True, scope="module")
def released_weights(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Small networks in place of the released ones, so that every method loads."""
    folder = save_all(tmp_path_factory.mktemp("weights"))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(find_weights, "packaged_folder", lambda: folder)
        yield


def with_holes(frame: RgbdFrame) -> RgbdFrame:
    depth = frame.depth.copy()
    depth[20:40, 30:60] = 0
    depth[::17, ::13] = 0
    return dataclasses.replace(frame, depth=depth)


def error(flow: Float32Array, truth: analytic.AnalyticPair, where: BoolMask) -> float:
    return float(np.linalg.norm(flow[where] - truth.scene_flow[where], axis=-1).mean())


# --- load ---


WITH_CAMERA = sorted(
    name for name in objectflow.METHODS if "camera" in {field.name for field in dataclasses.fields(find_class(name))}
)


@pytest.mark.parametrize("name", sorted(objectflow.METHODS))
def test_every_method_of_the_table_loads(name: str) -> None:
    entry = objectflow.METHODS[name]
    estimator = objectflow.load(name)
    assert type(estimator) is getattr(importlib.import_module(entry.module), entry.factory) is find_class(name)
    assert isinstance(estimator, PairEstimator)
    assert entry.summary


def test_methods_whose_result_depends_on_the_camera_have_its_option() -> None:
    assert set(objectflow.METHODS) - set(WITH_CAMERA) == {"zero", "dense-flow"}
    for name in WITH_CAMERA:
        assert objectflow.load(name).camera == "auto"  # type: ignore[attr-defined]
        assert objectflow.load(name, camera="static").camera == "static"  # type: ignore[attr-defined]


@pytest.mark.parametrize("camera", ["auto", "moving"])
@pytest.mark.parametrize("name", ["rigidmatch", "sceneflownet-c-vl", "pd-flow", "consensus"])
def test_a_moving_camera_needs_no_wrapper(name: str, camera: str) -> None:
    """The settings and the parts of a method are accessible whatever the camera does."""
    estimator = objectflow.load(name, camera=camera)
    assert type(estimator) is find_class(name)
    assert isinstance(estimator, PairEstimator)
    assert estimator.camera == camera  # type: ignore[attr-defined]


def test_the_settings_of_the_default_method_are_accessible_with_a_moving_camera() -> None:
    settings = {"camera": "moving", "postprocess.merge.max_loss": "0.1", "threshold": 0.2}
    estimator = objectflow.load("rigidmatch", **settings)
    assert estimator.threshold == 0.2  # type: ignore[attr-defined]
    assert estimator.postprocess.merge.max_loss == 0.1  # type: ignore[attr-defined]
    assert estimator.weights.name == "rigidmatch.safetensors"  # type: ignore[attr-defined]


def test_the_default_method_is_in_the_table() -> None:
    assert type(objectflow.load()) is type(objectflow.load(objectflow.DEFAULT_METHOD))


def test_unknown_methods_and_settings_list_the_choices() -> None:
    with pytest.raises(MethodError, match="unknown method 'dense-flaw': did you mean 'dense-flow'") as caught:
        objectflow.load("dense-flaw")
    assert all(name in str(caught.value) for name in objectflow.METHODS)
    with pytest.raises(MethodError, match="unknown method 'xyz': choose one of"):
        objectflow.load("xyz")
    with pytest.raises(SettingsError, match="unknown setting speed: the method zero has no settings; ") as caught:
        objectflow.load("zero", speed=3)
    having = str(caught.value).split("methods with settings: ")[1].split(", ")
    assert sorted(having) == sorted(set(objectflow.METHODS) - {"zero", "dense-flow"})
    with pytest.raises(SettingsError, match=r"unknown setting tresh: did you mean threshold\? choose one of camera, "):
        objectflow.load("rigidmatch", tresh=3)


@pytest.mark.parametrize("name", WITH_CAMERA)
def test_a_camera_that_is_no_choice_is_rejected(name: str) -> None:
    with pytest.raises(SettingsError, match="setting camera must be one of auto, static, moving, not 'flying'"):
        objectflow.load(name, camera="flying")


@pytest.mark.parametrize("name", sorted(objectflow.METHODS))
def test_frames_that_cannot_be_compared_are_rejected(name: str) -> None:
    pair, estimator = scene(0), objectflow.load(name)
    with pytest.raises(FrameError, match="both must have one size"):
        estimator(pair.prev.resized(160, 120), pair.curr)
    other = dataclasses.replace(pair.prev, camera=Camera(320, 240, 300.0, 300.0, 159.5, 119.5))
    with pytest.raises(FrameError, match="different intrinsics"):
        estimator(other, pair.curr)


@pytest.mark.parametrize("name", ["rigidmatch", "consensus", "sceneflownet-c-vl", "dense-flow", "zero"])
def test_prepared_pairs_give_the_same_result_as_frames(name: str) -> None:
    pair, estimator = scene(0), objectflow.load(name)
    expected, found = estimator(pair.prev, pair.curr), estimate_pair(estimator, FramePair(pair.prev, pair.curr))
    np.testing.assert_array_equal(found.labels, expected.labels)
    np.testing.assert_array_equal(found.scene_flow, expected.scene_flow)
    assert (found.method, expected.method) == (name, name)


# --- zero and dense-flow ---


def test_zero_reports_no_motion() -> None:
    pair = scene(0)
    motion = objectflow.load("zero")(pair.prev, with_holes(pair.curr))
    measured = with_holes(pair.curr).valid
    assert (motion.scene_flow[measured] == 0).all()
    assert (motion.labels == 0).all()
    assert (motion.objects, motion.method, motion.camera_motion) == ((), "zero", None)


@pytest.mark.parametrize("name", ["zero", "dense-flow"])
def test_flow_is_nan_exactly_where_depth_is_missing(name: str) -> None:
    pair = scene(0)
    curr = with_holes(pair.curr)
    motion = objectflow.load(name)(with_holes(pair.prev), curr)
    np.testing.assert_array_equal(np.isnan(motion.scene_flow).any(-1), ~curr.valid)
    np.testing.assert_array_equal(np.isnan(motion.scene_flow).all(-1), ~curr.valid)
    assert motion.seconds > 0


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_dense_flow_beats_zero_on_moving_objects_and_is_nearly_zero_on_the_background(seed: int) -> None:
    pair = scene(seed)
    motion = objectflow.load("dense-flow")(pair.prev, pair.curr)
    seen = pair.visible & pair.curr.valid
    moving = seen & np.isin(pair.labels, list(pair.moving))
    flow, nothing = motion.scene_flow, np.zeros_like(motion.scene_flow)
    assert error(flow, pair, moving) < 0.6 * error(nothing, pair, moving)
    static = np.linalg.norm(flow[seen & (pair.labels == 0)], axis=-1)
    assert np.median(static) < 0.0005
    assert (motion.labels == 0).all()


def test_dense_flow_of_a_pair_without_matches_is_zero_where_there_is_depth() -> None:
    camera = Camera(64, 48, 60.0, 60.0, 31.5, 23.5)
    color = np.zeros((48, 64, 3), np.uint8)
    left, right = np.zeros((48, 64), np.float32), np.zeros((48, 64), np.float32)
    left[:, :5], right[:, -5:] = 1, 1  # no pixel has depth in both frames
    motion = objectflow.load("dense-flow")(RgbdFrame(color, left, camera), RgbdFrame(color, right, camera))
    assert (motion.scene_flow[right > 0] == 0).all()
    assert np.isnan(motion.scene_flow[right == 0]).all()


# --- matching ---


def sample(depth: Float32Array, *pixels: Sequence[float]) -> tuple[list[float], list[bool]]:
    values, ok = matching.sample_depth(depth, np.array(pixels, np.float32))
    return values.tolist(), ok.tolist()


def test_depth_is_sampled_bilinearly_up_to_the_border() -> None:
    v, u = np.mgrid[0:4, 0:6].astype(np.float32)
    depth = (1 + 0.002 * u + 0.001 * v).astype(np.float32)
    values, ok = sample(depth, (0, 0), (5, 3), (2.5, 1.25), (5, 0.5), (0.25, 3))
    np.testing.assert_allclose(values, [1, 1.013, 1.00625, 1.0105, 1.0035], atol=1e-6)
    assert ok == [True] * 5


def test_depth_is_not_sampled_outside_on_holes_or_across_edges() -> None:
    depth = np.ones((6, 8), np.float32)
    depth[:, 4:] = 1.2
    depth[4, 1] = 0
    outside = [(-0.01, 2), (7.01, 2), (2, -0.01), (2, 5.01), (np.nan, 2), (2, np.inf), (-np.inf, 0)]
    assert sample(depth, *outside)[1] == [False] * 7
    assert sample(depth, (1, 4), (0.5, 3.5), (1.5, 4.2))[1] == [False] * 3
    assert sample(depth, (3.5, 1), (3.01, 1))[1] == [False] * 2
    assert sample(depth, (2.5, 1), (4.5, 1), (6.5, 4.5))[1] == [True] * 3


def test_the_depth_step_that_ends_a_surface_is_a_setting() -> None:
    depth = np.ones((6, 8), np.float32)
    depth[:, 4:] = 1.2
    pixel = np.array([[3.5, 1]], np.float32)
    for step, accepted in ((0.19, False), (0.21, True)):
        settings = matching.MatchSettings(surface_step_ratio=0.0, surface_step=step)
        assert matching.sample_depth(depth, pixel, settings)[1].tolist() == [accepted]


def test_no_pixels_give_no_depth() -> None:
    values, ok = matching.sample_depth(np.ones((6, 8), np.float32), np.zeros((0, 2), np.float32))
    assert (values.shape, ok.shape) == ((0,), (0,))


def test_lifted_matches_are_the_back_projected_points() -> None:
    pair = scene(0)
    curr, prev = with_holes(pair.curr), with_holes(pair.prev)
    v, u = np.mgrid[10:230:7, 10:310:7]
    pixels = np.stack([u.ravel(), v.ravel()], axis=1).astype(np.float32)
    matches, keep = matching.lift(pixels, pixels + np.float32(2), prev, curr)
    assert 0.5 < keep.mean() < 1
    np.testing.assert_array_equal(matches.pixels, pixels[keep])
    row, column = pixels[keep].astype(int).T[::-1]
    np.testing.assert_allclose(matches.curr, geometry.back_project(curr.depth, curr.camera)[row, column], atol=1e-6)
    expected = geometry.back_project(prev.depth, prev.camera)[row + 2, column + 2]
    np.testing.assert_allclose(matches.prev, expected, atol=1e-6)
    halves = matches[np.arange(10)] + matches[np.arange(len(matches.pixels)) >= 10]
    np.testing.assert_array_equal(halves.prev, matches.prev)


def moved_picture(shift: tuple[int, int]) -> tuple[RgbdFrame, RgbdFrame, Float64Array]:
    """A flat picture at 1 m that moved by whole pixels: prev, curr, and the shift from curr to prev in metres."""
    rng = np.random.default_rng(0)
    big = np.kron(rng.integers(0, 256, (40, 50, 3)), np.ones((4, 4, 1))).astype(np.uint8)
    camera, depth = Camera(128, 96, 100.0, 100.0, 63.5, 47.5), np.ones((96, 128), np.float32)
    du, dv = shift
    prev = RgbdFrame(np.ascontiguousarray(big[20:116, 20:148]), depth, camera)
    curr = RgbdFrame(np.ascontiguousarray(big[20 + dv : 116 + dv, 20 + du : 148 + du]), depth, camera)
    return prev, curr, np.array([du / 100, dv / 100, 0])


def test_dense_flow_and_its_matches_find_a_known_shift() -> None:
    prev, curr, shift = moved_picture((3, -2))
    flow, consistent = matching.dense_flow(to_gray(prev.color), to_gray(curr.color))
    assert consistent[8:-8, 8:-8].mean() > 0.95
    np.testing.assert_allclose(np.median(flow[consistent], axis=0), [3, -2], atol=0.05)
    matches = matching.flow_matches(flow, consistent, prev, curr, stride=4)
    assert len(matches.pixels) > 0.7 * (96 / 4) * (128 / 4)
    assert (matches.pixels % 4 == 2).all()
    np.testing.assert_allclose(np.median(matches.prev - matches.curr, axis=0), shift, atol=0.001)


def test_features_find_a_large_shift() -> None:
    prev, curr, shift = moved_picture((18, -14))
    matches = matching.feature_matches(prev, curr)
    assert len(matches.pixels) >= 20
    off = np.linalg.norm(matches.prev - matches.curr - shift, axis=1)
    assert np.median(off) < 0.002
    assert (off < 0.01).mean() > 0.9


def test_images_without_features_have_no_matches() -> None:
    prev, curr, _ = moved_picture((0, 0))
    plain = dataclasses.replace(prev, color=np.full_like(prev.color, 90))
    assert len(matching.feature_matches(plain, curr).pixels) == 0
    assert len(matching.feature_matches(curr, plain).pixels) == 0


@pytest.mark.parametrize("size", [(1, 1), (8, 8), (3, 40), (11, 12)])
@pytest.mark.parametrize(
    ("method", "options"),
    [
        ("dense-flow", {}),
        *((name, {"camera": camera}) for name in ("consensus", "pd-flow") for camera in ("auto", "moving")),
    ],
)
def test_images_too_small_to_match_give_a_result(method: str, options: dict[str, str], size: tuple[int, int]) -> None:
    height, width = size
    noise = np.random.default_rng(0).integers(0, 255, (2, height, width, 3), dtype=np.uint8)
    lens = Camera(width, height, float(width), float(width), (width - 1) / 2, (height - 1) / 2)
    prev, curr = (RgbdFrame(color, np.ones(size, np.float32), lens) for color in noise)
    assert objectflow.load(method, **options)(prev, curr).labels.shape == size
