"""Second pass of an evaluation: score the cached predictions."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from objectflow import __version__
from objectflow.errors import DatasetError
from objectflow.evaluation.cache import MethodCache, Prediction
from objectflow.evaluation.data.sources import PairSet
from objectflow.evaluation.methods import MethodSpec
from objectflow.evaluation.metrics.pair_score import PairScore, score_pair
from objectflow.evaluation.predict import FOLDER
from objectflow.evaluation.results import Evaluation, EvaluationPair, Failure, MethodResult, facts_of
from objectflow.evaluation.runtime import machine_name, summarise_runtime
from objectflow.evaluation.tables.summary import Summary, summarise
from objectflow.motion import SceneMotion

SEED = 0
"""Seed of the bootstrap, so that the same predictions give the same intervals."""

NOT_CACHED = "no cached prediction that can be read"
"""Reason of a failure that no method reported."""


class CachedPairs:
    """The frames, truths and cached predictions of an evaluation; see `PairSource`."""

    def __init__(self, pairs: PairSet, methods: Sequence[MethodSpec], out: Path) -> None:
        self._pairs = pairs
        self._caches = {spec.label: MethodCache(out / FOLDER / spec.folder) for spec in methods}

    def pair(self, key: str) -> EvaluationPair:
        """See `PairSource`."""
        return self._pairs.pair(key)

    def prediction(self, label: str, key: str) -> SceneMotion | None:
        """See `PairSource`."""
        found = self._caches[label].read(key)
        return None if found is None else found.motion


class _MethodScorer:
    """Collects the scores of one method's predictions, pair by pair."""

    def __init__(self, spec: MethodSpec, cache: MethodCache) -> None:
        self._spec, self._cache = spec, cache
        self._scores: list[PairScore] = []
        self._failures: list[Failure] = []
        self._warm: list[float] = []
        self._machines: dict[str, None] = {}

    def add(self, key: str, pair: EvaluationPair) -> None:
        found = self._cache.read(key)
        if found is None:
            self._failures.append(Failure(key, self._cache.failure(key) or NOT_CACHED))
            return
        self._scores.append(score_pair(found.motion, pair.truth))
        self._add_time(found)

    def result(self) -> MethodResult:
        return MethodResult(
            label=self._spec.label,
            method=self._spec.name,
            options=self._spec.options,
            oracle=self._spec.oracle,
            summary=self._summary() if self._scores else None,
            failures=tuple(self._failures),
            scores=tuple(self._scores),
        )

    def _add_time(self, found: Prediction) -> None:
        self._machines[found.machine] = None
        if not found.cold:
            self._warm.append(found.motion.seconds)

    def _summary(self) -> Summary:
        summary = summarise(self._scores, np.random.default_rng(SEED))
        seconds = self._warm or [score.seconds for score in self._scores]
        runtime = summarise_runtime(seconds, warm_up=0, machine="; ".join(self._machines))
        runtime = dataclasses.replace(runtime, warm_up=len(self._scores) - len(seconds))
        return dataclasses.replace(summary, runtime=runtime)


def score(
    pairs: PairSet,
    keys: Sequence[str],
    methods: Sequence[MethodSpec],
    out: Path,
    *,
    report: Callable[[int], None] = lambda _: None,
) -> Evaluation:
    """Score the cached predictions of every method.

    Args:
        pairs: the set.
        keys: of the pairs to score.
        methods: in the order of the tables.
        out: the output folder of `predict`.
        report: called with the number of pairs scored so far.

    Raises:
        DatasetError: no pairs, or one that cannot be read.
    """
    if not keys:
        raise DatasetError(f"{pairs.data}: no pairs to evaluate")
    scorers = [_MethodScorer(spec, MethodCache(out / FOLDER / spec.folder)) for spec in methods]
    facts = []
    for number, key in enumerate(keys, start=1):
        pair = pairs.pair(key)
        facts.append(facts_of(pair.truth))
        for scorer in scorers:
            scorer.add(key, pair)
        report(number)
    return Evaluation(
        data=pairs.data,
        kind=pairs.kind,
        split=pairs.split,
        sha256=pairs.sha256,
        total=len(pairs.keys),
        machine=machine_name(),
        version=__version__,
        pairs=tuple(facts),
        methods=tuple(scorer.result() for scorer in scorers),
    )
