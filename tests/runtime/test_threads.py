"""One estimator in several threads, and in spawned processes, gives the results of one thread."""

from __future__ import annotations

import multiprocessing
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor

import pytest
import torch

import analytic
import objectflow
from objectflow import RgbdFrame, SceneMotion

METHODS = ("consensus", "rigidmatch")


def frames(seed: int) -> tuple[RgbdFrame, RgbdFrame]:
    scene = analytic.make_scene(seed, width=160, height=120)
    return scene.prev, scene.curr


def estimate(method: str, prev: RgbdFrame, curr: RgbdFrame) -> SceneMotion:
    torch.set_num_threads(1)
    return objectflow.load(method, camera="static")(prev, curr)


@pytest.mark.parametrize("method", METHODS)
def test_threads_share_an_estimator(method: str) -> None:
    estimator = objectflow.load(method, camera="static")
    pairs = [frames(seed) for seed in range(4)]
    alone = [estimator(*pair) for pair in pairs]
    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(lambda pair: estimator(*pair), pairs * 2))
    assert together == alone * 2


def test_spawned_processes_give_the_same() -> None:
    prev, curr = frames(1)
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        there = pool.submit(estimate, "consensus", prev, curr).result(timeout=120)
    assert there == estimate("consensus", prev, curr)
