"""The estimates of a run's pairs: in the process itself, or side by side by `--workers` and `--ray`."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

from objectflow.alignment.frame_pair import FramePair
from objectflow.cli.run_pairs import ReadablePairs
from objectflow.frame import RgbdFrame
from objectflow.methods.base import Estimator, estimate_pair
from objectflow.motion import SceneMotion
from objectflow.runtime.make_pool import make_pool
from objectflow.runtime.pool import Pool
from objectflow.runtime.threads import share_cores


class RunPair(NamedTuple):
    """A pair of a run.

    Attributes:
        prev_index, curr_index: frame numbers.
        prev, curr: the frames; None where the pair is done.
        motion: the estimate of a worker; None where there are no workers, or the pair is done.
    """

    prev_index: int
    curr_index: int
    prev: RgbdFrame | None = None
    curr: RgbdFrame | None = None
    motion: SceneMotion | None = None


RUN_PAIRS = 4
"""Maximum number of consecutive pairs of one job. What a worker prepares of a frame serves both of its pairs; more
pairs per job leave workers idle at the end of a recording."""

FrameJob = tuple[RgbdFrame, ...]
"""Consecutive frames, each pair of which a worker estimates; no frames for a pair that is done, which keeps its place
in the order."""


@dataclass(frozen=True)
class EstimateFactory:
    """Makes the function of a worker: the estimator itself, on the worker's share of the cores.

    Attributes:
        estimator: of the pairs.
        workers: see `share_cores`.
    """

    estimator: Estimator
    workers: int | None

    def __call__(self) -> Callable[[FrameJob], list[SceneMotion | None]]:
        """Make the function; called once in each worker."""
        share_cores(self.workers)
        return self._estimate

    def _estimate(self, job: FrameJob) -> list[SceneMotion | None]:
        if not job:
            return [None]
        pair = FramePair(job[0], job[1])
        motions: list[SceneMotion | None] = [estimate_pair(self.estimator, pair)]
        for frame in job[2:]:
            pair = pair.followed_by(frame)
            motions.append(estimate_pair(self.estimator, pair))
        return motions


def read_pairs(
    numbers: Iterable[tuple[int, int]], pairs: ReadablePairs, is_done: Callable[[int, int], bool]
) -> Iterator[RunPair]:
    """The pairs with their frames; those that are done are not read."""
    last: tuple[int, RgbdFrame] | None = None
    for prev_index, curr_index in numbers:
        if is_done(prev_index, curr_index):
            yield RunPair(prev_index, curr_index)
            continue
        curr = pairs.read(curr_index)
        prev = last[1] if last is not None and last[0] == prev_index else pairs.sequence[prev_index]
        last = curr_index, curr
        yield RunPair(prev_index, curr_index, prev, curr)


def estimate_pairs(
    pairs: Iterable[RunPair], estimator: Estimator, workers: int, ray: str | None
) -> Generator[RunPair, None, None]:
    """The pairs in their order, each with its estimate where there are workers.

    Args:
        pairs: a few jobs of `RUN_PAIRS` pairs are drawn ahead per worker.
        estimator: picklable where there are workers.
        workers, ray: see `make_pool`. One worker without Ray estimates nothing here: in its own process, a sequence
            estimates a pair with what it has prepared of the last one.
    """
    if workers == 1 and ray is None:
        yield from pairs
        return
    pool: Pool[FrameJob, list[SceneMotion | None]] = make_pool(
        EstimateFactory(estimator, workers if ray is None else None), workers, ray
    )
    waiting: deque[RunPair] = deque()

    def noted() -> Iterator[RunPair]:
        for pair in pairs:
            waiting.append(pair)
            yield pair

    try:
        for motions in pool.run(frame_jobs(noted())):
            for motion in motions:
                yield waiting.popleft()._replace(motion=motion)
    finally:
        pool.close()


def frame_jobs(pairs: Iterable[RunPair]) -> Iterator[FrameJob]:
    """The frames of up to `RUN_PAIRS` consecutive pairs at a time; no frames for each pair that is done."""
    frames: list[RgbdFrame] = []
    last = -1
    for pair in pairs:
        if frames and (pair.prev_index != last or pair.curr is None or len(frames) > RUN_PAIRS):
            yield tuple(frames)
            frames = []
        last = pair.curr_index
        if pair.prev is None or pair.curr is None:
            yield ()
        else:
            frames += [pair.curr] if frames else [pair.prev, pair.curr]
    if frames:
        yield tuple(frames)
