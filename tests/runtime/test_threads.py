"""One estimator in several threads, after pickling, and in forked and spawned processes gives the same results."""

from __future__ import annotations

import multiprocessing
import pickle
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor

import numpy as np
import pytest
import torch
from threadpoolctl import threadpool_info, threadpool_limits

import analytic
import objectflow
from objectflow import RgbdFrame, SceneMotion

METHODS = ("consensus", "rigidmatch")


@pytest.fixture
def two_threads() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)


def frames(seed: int) -> tuple[RgbdFrame, RgbdFrame]:
    scene = analytic.make_scene(seed, width=160, height=120)
    return scene.prev, scene.curr


def estimate(method: str, prev: RgbdFrame, curr: RgbdFrame) -> SceneMotion:
    torch.set_num_threads(1)
    return objectflow.load(method, camera="static")(prev, curr)


@pytest.mark.parametrize("method", METHODS)
def test_threads_share_an_estimator(method: str) -> None:
    estimator = objectflow.load(method, camera="static")
    pairs = [frames(seed) for seed in range(2)]
    alone = [estimator(*pair) for pair in pairs]
    with ThreadPoolExecutor(8) as pool:
        together = list(pool.map(lambda pair: estimator(*pair), pairs * 4))
    assert together == alone * 4


def blas_threads() -> set[int]:
    return {library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"}


@pytest.mark.parametrize("method", METHODS)
def test_an_estimate_uses_one_thread_of_linear_algebra(method: str, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[set[int]] = []
    solve = np.linalg.solve
    monkeypatch.setattr(np.linalg, "solve", lambda *args: seen.append(blas_threads()) or solve(*args))
    with threadpool_limits(limits=2, user_api="blas"):
        before = blas_threads()
        objectflow.load(method, camera="static")(*frames(1))
        assert blas_threads() == before
    assert seen
    assert all(one == {1} for one in seen)


def test_spawned_processes_give_the_same() -> None:
    prev, curr = frames(1)
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        there = pool.submit(estimate, "consensus", prev, curr).result(timeout=120)
    assert there == estimate("consensus", prev, curr)


@pytest.mark.parametrize("method", METHODS)
def test_a_process_forked_after_an_estimate_gives_the_same(method: str, two_threads: None) -> None:
    """With several threads in the parent, torch's pool exists at the fork; without care, the child waits for it."""
    prev, curr = frames(1)
    estimator = objectflow.load(method, camera="static")
    torch.ones(4_000_000).exp().sum()  # large enough for the pool
    here = estimator(prev, curr)
    context = multiprocessing.get_context("fork")
    receiver, sender = context.Pipe(duplex=False)
    child = context.Process(target=lambda: sender.send((torch.get_num_threads(), estimator(prev, curr))))
    child.start()
    try:
        assert receiver.poll(120), "the forked child hangs"
        threads, there = receiver.recv()
    finally:
        child.kill()
        child.join()
    assert threads == 1
    assert np.array_equal(there.labels, here.labels)
    assert np.allclose(there.scene_flow, here.scene_flow, atol=1e-5, equal_nan=True)
    torch.set_num_threads(1)
    assert there == estimator(prev, curr)


@pytest.mark.parametrize("method", METHODS)
def test_pickling_changes_no_result(method: str) -> None:
    estimator, pair = objectflow.load(method, camera="static"), frames(2)
    result = estimator(*pair)
    again, pair_again, result_again = pickle.loads(pickle.dumps((estimator, pair, result)))
    assert result_again == result
    assert again(*pair_again) == result


def test_one_and_two_threads_give_the_same_bits_before_a_static_camera(two_threads: None) -> None:
    """With two threads, the network is evaluated beside the estimate of the camera's motion."""
    scene = analytic.make_scene(3, width=320, height=240)
    estimator = objectflow.load("rigidmatch", camera="auto")
    pair = objectflow.FramePair(scene.prev, scene.curr)
    estimator.start(pair)
    assert len(pair.beside) == 1  # the camera is expected to be static
    together = [estimator.estimate(pair), estimator(scene.prev, scene.curr)]
    assert not pair.beside
    torch.set_num_threads(1)
    assert together == [estimator(scene.prev, scene.curr)] * 2


def test_a_camera_that_moved_is_found_with_two_threads(two_threads: None) -> None:
    prev_T_curr = np.eye(4)
    prev_T_curr[0, 3] = 0.02
    scene = analytic.make_scene(3, width=320, height=240, camera_motion=prev_T_curr)
    estimator = objectflow.load("rigidmatch", likely_static_px=1e3)
    pair = objectflow.FramePair(scene.prev, scene.curr)
    found = estimator.estimate(pair)
    expected = objectflow.load("rigidmatch", likely_static_px=0.0)(scene.prev, scene.curr)
    assert found.camera_motion is not None
    assert np.array_equal(found.camera_motion, expected.camera_motion)
    assert np.array_equal(found.labels, expected.labels)
    assert np.allclose(found.scene_flow, expected.scene_flow, atol=1e-5, equal_nan=True)
