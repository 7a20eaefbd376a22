"""First pass: run every method on every pair and cache what it says. Only oracles are ever given the truth."""

from __future__ import annotations

import dataclasses
import os
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from objectflow import __version__
from objectflow.errors import ObjectflowError
from objectflow.evaluation.cache import MethodCache, encode
from objectflow.evaluation.data.sources import PairSet, PairWindow
from objectflow.evaluation.data.truth import PairTruth
from objectflow.evaluation.methods import MethodSpec, SequenceEstimator
from objectflow.evaluation.results import EvaluationPair
from objectflow.evaluation.runtime import machine_name
from objectflow.frame import RgbdFrame
from objectflow.methods.base import Estimator
from objectflow.motion import SceneMotion
from objectflow.runtime.make_pool import Workers, check_workers

FOLDER = "predictions"
FORMAT = 1
"""Of the cached files."""

SEQUENCES = ("sequences", "consecutive")
"""Kinds of sets whose pairs have a window."""


@dataclass(frozen=True, eq=False)
class PredictionJob:
    """One method on one pair. `truth` is there for oracles alone, `window` for methods that take sequences."""

    method: int
    key: str
    prev: RgbdFrame
    curr: RgbdFrame
    window: PairWindow | None = None
    truth: PairTruth | None = None


@dataclass(frozen=True)
class Answer:
    """The bytes of a cached file, or why there are none."""

    key: str
    data: bytes | None
    reason: str = ""


@dataclass(frozen=True)
class PredictionProgress:
    """How far a pass is: `done` of `total` rows of the method `label`, `failed` of them in vain."""

    label: str
    done: int
    total: int
    failed: int


def predict(
    pairs: PairSet,
    keys: Sequence[str],
    methods: Sequence[MethodSpec],
    out: Path,
    *,
    workers: int = 1,
    ray: str | None = None,
    report: Callable[[PredictionProgress], None] = lambda _: None,
) -> None:
    """Cache the predictions that `out/predictions` does not hold yet.

    Rows on which a method failed are tried again; one more failure is recorded, counted and stops nothing.

    Args:
        pairs: the set.
        keys: the pairs to be run.
        methods: what to run.
        out: where `predictions` is, or will be.
        workers: processes, or Ray actors. Estimates that run side by side take longer each.
        ray: see `Workers`.
        report: told after every row.

    Raises:
        MethodError: fewer than one worker.
        ResultError: cached predictions were made with other settings or from other data.
        DatasetError: a pair that cannot be read, or a worker that died.
        StorageError: the disk refused.
    """
    check_workers(workers)
    caches = [MethodCache(out / FOLDER / spec.folder) for spec in methods]
    for spec, cache in zip(methods, caches, strict=True):  # before hours of work for the first of them
        cache.check(settings_of(spec, pairs))
    pool: Workers | None = None
    try:
        for number, (spec, cache) in enumerate(zip(methods, caches, strict=True)):
            with cache.claim(settings_of(spec, pairs)):
                todo = [key for key in keys if not cache.has(key)]
                done, failed = len(keys) - len(todo), 0
                report(PredictionProgress(spec.label, done, len(keys), failed))
                if not todo:
                    continue
                pool = pool or Workers(PredictorFactory(tuple(methods), workers, ray is not None), workers, ray)
                for answer in pool.run(_jobs(pairs, todo, number, spec)):
                    if answer.data is None:
                        cache.write_failure(answer.key, answer.reason)
                        failed += 1
                    else:
                        cache.write(answer.key, answer.data)
                    done += 1
                    report(PredictionProgress(spec.label, done, len(keys), failed))
    finally:
        if pool is not None:
            pool.close()


def settings_of(spec: MethodSpec, pairs: PairSet) -> dict[str, Any]:
    """Everything that a prediction depends on."""
    return {
        "method": spec.name,
        "label": spec.label,
        "options": spec.settings,
        "sha256": pairs.sha256,
        "kind": pairs.kind,
        "split": pairs.split,
        "version": __version__,
        "format": FORMAT,
    }


def _jobs(pairs: PairSet, keys: Sequence[str], number: int, spec: MethodSpec) -> Iterator[PredictionJob]:
    in_sequence = pairs.kind in SEQUENCES and not spec.oracle and isinstance(spec.make(), SequenceEstimator)
    for key in keys:
        pair: EvaluationPair = pairs.pair(key)
        window = pairs.window(key) if in_sequence else None
        yield PredictionJob(number, key, pair.prev, pair.curr, window, pair.truth if spec.oracle else None)


@dataclass(frozen=True)
class PredictorFactory:
    """Makes a worker's `Predictor`; each of several workers on one machine gets its share of the cores."""

    methods: tuple[MethodSpec, ...]
    workers: int = 1
    ray: bool = False

    def __call__(self) -> Predictor:
        """Called once in each worker."""
        if self.workers > 1 or self.ray:
            _limit_threads(1 if self.ray else max(1, _cores() // self.workers))
        machine = machine_name()
        return Predictor(self.methods, machine if self.workers == 1 else f"{machine}, {self.workers} at a time")


class Predictor:
    """Runs jobs; keeps each method's estimator from pair to pair."""

    def __init__(self, methods: tuple[MethodSpec, ...], machine: str) -> None:
        self._methods, self._machine = methods, machine
        self._estimators: dict[int, Estimator] = {}
        self._warm: set[int] = set()

    def __call__(self, job: PredictionJob) -> Answer:
        """One prediction; whatever a method raises becomes the reason of its failure."""
        try:
            estimator = self._estimator(job)
            start = time.perf_counter()
            motion = _run(estimator, job)
            seconds = time.perf_counter() - start
            _check(motion, job.curr)
        except Exception as error:  # methods may raise anything; one row of one method must not end the others
            reason = str(error) if isinstance(error, ObjectflowError) else f"{type(error).__name__}: {error}"
            return Answer(job.key, None, " ".join(reason.split())[:300])
        cold = job.method not in self._warm
        self._warm.add(job.method)
        timed = dataclasses.replace(motion, seconds=seconds)
        return Answer(job.key, encode(timed, cold=cold, machine=self._machine))

    def _estimator(self, job: PredictionJob) -> Estimator:
        if job.truth is not None:
            return self._methods[job.method].make(job.truth)
        if job.method not in self._estimators:
            self._estimators[job.method] = self._methods[job.method].make()
        return self._estimators[job.method]


def _run(estimator: Estimator, job: PredictionJob) -> SceneMotion:
    if job.window is not None and isinstance(estimator, SequenceEstimator):
        return estimator.estimate_in_sequence(*job.window)
    return estimator(job.prev, job.curr)


def _check(motion: object, curr: RgbdFrame) -> None:
    if not isinstance(motion, SceneMotion):
        raise TypeError(f"it returned {type(motion).__name__}, not a SceneMotion")
    if motion.labels.shape != curr.depth.shape:
        raise ValueError(f"its result is {motion.labels.shape}, the frame {curr.depth.shape}")
    if motion.labels.min(initial=0) < 0:
        raise ValueError("its labels are negative")


def _limit_threads(count: int) -> None:
    import cv2
    import torch

    cv2.setNumThreads(count)
    torch.set_num_threads(count)


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
