"""First pass of an evaluation: run every method on every pair and cache the results. Only oracles get the truth."""

from __future__ import annotations

import dataclasses
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
from objectflow.runtime.make_pool import check_workers, make_pool
from objectflow.runtime.pool import Pool
from objectflow.runtime.threads import share_cores

FOLDER = "predictions"
"""Name of the folder of cached predictions."""

FORMAT = 2
"""Version of the cached files; 2 added the key to each file, and names that differ for different keys."""

SEQUENCES = ("sequences", "consecutive")
"""Kinds of sets whose pairs are part of a sequence."""


@dataclass(frozen=True, eq=False)
class PredictionJob:
    """One method on one pair; `truth` is set only for oracles, `window` only for methods that take sequences."""

    method: int
    key: str
    prev: RgbdFrame
    curr: RgbdFrame
    window: PairWindow | None = None
    truth: PairTruth | None = None


@dataclass(frozen=True)
class PredictionResult:
    """The bytes of a cached file, or the reason why the method failed."""

    key: str
    data: bytes | None
    reason: str = ""


@dataclass(frozen=True)
class PredictionProgress:
    """Progress of a pass: `done` of `total` pairs of the method `label`, `failed` of them without a result."""

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

    Pairs on which a method failed are tried again; a failure is recorded and counted, and the pass continues.

    Args:
        pairs: the set.
        keys: of the pairs to run.
        methods: to run.
        out: the folder of `predictions`.
        workers: number of processes or Ray actors. Each estimate takes longer if several run in parallel.
        ray: see `make_pool`.
        report: called after every pair.

    Raises:
        MethodError: fewer than one worker.
        ResultError: cached predictions of other settings or other data.
        DatasetError: a pair that cannot be read, or a worker that died.
        StorageError: a file cannot be written.
    """
    check_workers(workers)
    caches = [MethodCache(out / FOLDER / spec.folder) for spec in methods]
    for spec, cache in zip(methods, caches, strict=True):  # all of them before hours of work on the first
        cache.check(settings_of(spec, pairs))
    pool: Pool[PredictionJob, PredictionResult] | None = None
    try:
        for number, (spec, cache) in enumerate(zip(methods, caches, strict=True)):
            with cache.claim(settings_of(spec, pairs)):
                todo = [key for key in keys if not cache.has(key)]
                done, failed = len(keys) - len(todo), 0
                report(PredictionProgress(spec.label, done, len(keys), failed))
                if not todo:
                    continue
                pool = pool or make_pool(PredictorFactory(tuple(methods), workers, ray is not None), workers, ray)
                for result in pool.run(_jobs(pairs, todo, number, spec)):
                    if result.data is None:
                        cache.write_failure(result.key, result.reason)
                        failed += 1
                    else:
                        cache.write(result.key, result.data)
                    done += 1
                    report(PredictionProgress(spec.label, done, len(keys), failed))
    finally:
        if pool is not None:
            pool.close()


def settings_of(spec: MethodSpec, pairs: PairSet) -> dict[str, Any]:
    """Everything that a prediction depends on, as plain JSON."""
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
    """Makes the `Predictor` of a worker; several workers on one machine share its cores."""

    methods: tuple[MethodSpec, ...]
    workers: int = 1
    ray: bool = False

    def __call__(self) -> Predictor:
        """Make the predictor; called once in each worker."""
        if self.workers > 1 or self.ray:
            share_cores(None if self.ray else self.workers)
        machine = machine_name()
        return Predictor(self.methods, machine if self.workers == 1 else f"{machine}, {self.workers} at a time")


class Predictor:
    """Runs jobs, and keeps the estimator of each method between pairs."""

    def __init__(self, methods: tuple[MethodSpec, ...], machine: str) -> None:
        self._methods, self._machine = methods, machine
        self._estimators: dict[int, Estimator] = {}
        self._warm: set[int] = set()

    def __call__(self, job: PredictionJob) -> PredictionResult:
        """Make one prediction; an exception of the method becomes the reason of its failure."""
        try:
            estimator = self._estimator(job)
            start = time.perf_counter()
            motion = _run(estimator, job)
            seconds = time.perf_counter() - start
            _check(motion, job.curr)
        except Exception as error:  # methods may raise anything, which must not stop the other pairs and methods
            reason = str(error) if isinstance(error, ObjectflowError) else f"{type(error).__name__}: {error}"
            return PredictionResult(job.key, None, " ".join(reason.split())[:300])
        cold = job.method not in self._warm
        self._warm.add(job.method)
        timed = dataclasses.replace(motion, seconds=seconds)
        return PredictionResult(job.key, encode(timed, key=job.key, cold=cold, machine=self._machine))

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
