"""The jobs of a run's workers: consecutive pairs share their frames, and pairs that are done keep their place."""

from __future__ import annotations

import numpy as np

from objectflow import Camera, RgbdFrame
from objectflow.cli.run_estimates import RUN_PAIRS, RunPair, frame_jobs

CAMERA = Camera(16, 12, 15.0, 15.0, 7.5, 5.5)


def frame(index: int) -> RgbdFrame:
    color = np.zeros((12, 16, 3), np.uint8)
    return RgbdFrame(color, np.ones((12, 16), np.float32), CAMERA, name=str(index))


def jobs(*pairs: RunPair) -> list[list[str]]:
    return [[one.name for one in job] for job in frame_jobs(pairs)]


def pair(prev: int, curr: int) -> RunPair:
    return RunPair(prev, curr, frame(prev), frame(curr))


def test_consecutive_pairs_are_one_job() -> None:
    assert jobs(pair(0, 1), pair(1, 2), pair(2, 3)) == [["0", "1", "2", "3"]]


def test_a_job_has_a_limited_number_of_pairs() -> None:
    found = jobs(*(pair(k, k + 1) for k in range(RUN_PAIRS + 2)))
    assert [len(job) - 1 for job in found] == [RUN_PAIRS, 2]
    assert found[1][0] == found[0][-1]


def test_a_cut_starts_a_job() -> None:
    assert jobs(pair(0, 2), pair(2, 4), pair(5, 7)) == [["0", "2", "4"], ["5", "7"]]


def test_a_pair_that_is_done_is_an_empty_job() -> None:
    assert jobs(RunPair(0, 1), pair(1, 2), RunPair(2, 3), RunPair(3, 4), pair(4, 5)) == [
        [], ["1", "2"], [], [], ["4", "5"],
    ]  # fmt: skip


def test_no_pairs_are_no_jobs() -> None:
    assert jobs() == []
