"""Bootstrap intervals of means, ratios and medians by resampling scenes (Efron 1979, percentile method)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.random import Generator
from numpy.typing import ArrayLike

from objectflow.errors import DatasetError
from objectflow.typing import Float64Array

DRAWS = 1000
"""Number of resamples."""
COVERAGE = 0.95
"""Coverage of the intervals, 0..1."""
_BLOCK = 1 << 22
"""Maximum number of weights in memory: 32 MB for sets of any size."""


class Interval(NamedTuple):
    """A statistic of a set and its bootstrap interval; NaN if it is undefined."""

    value: float
    low: float
    high: float


class Bootstrap:
    """Resamples of a set, the same for every statistic.

    Whole scenes are resampled, since pairs of one scene are not independent.
    """

    def __init__(self, scenes: Sequence[str], rng: Generator, draws: int = DRAWS) -> None:
        """Number the scenes and draw a seed.

        Args:
            scenes: the scene of every pair.
            rng: used once, for the seed.
            draws: number of resamples.

        Raises:
            DatasetError: no pairs.
        """
        if len(scenes) == 0:
            raise DatasetError("no pairs were scored: there is nothing to average")
        numbers = {name: index for index, name in enumerate(dict.fromkeys(scenes))}
        self._scene = np.array([numbers[name] for name in scenes])
        self._seed = int(rng.integers(1 << 62))
        self._draws = draws
        self._kept: Float64Array | None = None

    def mean(self, values: ArrayLike) -> Interval:
        """The mean of one value per pair; NaN excludes a pair."""
        x = np.asarray(values, dtype=np.float64)
        finite = np.isfinite(x)
        return self.ratio(np.where(finite, x, 0), finite)

    def ratio(self, numerators: ArrayLike, denominators: ArrayLike) -> Interval:
        """The ratio of two sums over pairs."""
        sums = np.stack([np.asarray(numerators, np.float64), np.asarray(denominators, np.float64)], axis=1)
        return _interval(_divide(*sums.sum(0)), np.concatenate([_divide(*(w @ sums).T) for w in self.weights()]))

    def harmonic(self, precisions: ArrayLike, recalls: ArrayLike) -> Interval:
        """The harmonic mean of two means over pairs."""
        sums = np.stack([np.asarray(precisions, np.float64), np.asarray(recalls, np.float64)], axis=1)
        count = len(self._scene)

        def of(P: Float64Array, R: Float64Array) -> Float64Array:
            return np.where(P + R > 0, _divide(2 * P * R, P + R), 0.0)

        return _interval(
            of(*(sums.sum(0) / count)),
            np.concatenate([of(*(w @ sums / w.sum(1)[:, None]).T) for w in self.weights()]),
        )

    def median(self, values: ArrayLike, pairs: ArrayLike | None = None) -> Interval:
        """The median of values, of which the i-th belongs to pair `pairs[i]` (None: one per pair); NaN is excluded."""
        x = np.asarray(values, dtype=np.float64)
        owner = np.arange(len(x)) if pairs is None else np.asarray(pairs, dtype=np.int64)
        finite = np.isfinite(x)
        order = np.argsort(x[finite], kind="stable")
        x, owner = x[finite][order], owner[finite][order]
        if len(x) == 0:
            return _interval(np.array(np.nan), np.array([]))
        draws = np.concatenate([_weighted_median(x, w[:, owner]) for w in self.weights(len(x))])
        return _interval(np.asarray(np.median(x)), draws)

    def weights(self, width: int = 1) -> Iterator[Float64Array]:
        """Blocks of (draws, pairs): how often each pair is in each resample; every call gives the same numbers.

        Args:
            width: number of values per draw that the caller computes, which limits the size of a block.
        """
        block = max(1, _BLOCK // max(len(self._scene), width))
        if self._draws * len(self._scene) <= _BLOCK:  # drawing takes longer than the statistics
            if self._kept is None:
                self._kept = np.concatenate(list(self._draw(self._draws)))
            yield from (self._kept[start : start + block] for start in range(0, self._draws, block))
        else:
            yield from self._draw(block)

    def _draw(self, block: int) -> Iterator[Float64Array]:
        rng = np.random.default_rng(self._seed)
        count = int(self._scene.max()) + 1
        for start in range(0, self._draws, block):
            size = min(block, self._draws - start)
            yield rng.multinomial(count, np.full(count, 1 / count), size=size).astype(np.float64)[:, self._scene]


def _divide(numerator: Float64Array, denominator: Float64Array) -> Float64Array:
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(np.where(np.asarray(denominator) > 0, numerator / denominator, np.nan))


def _weighted_median(x: Float64Array, weights: Float64Array) -> Float64Array:
    """The median of sorted values x (N,), each repeated weights[d, n] times, for every draw d; NaN if all are 0."""
    cumulative = np.cumsum(weights, axis=1)
    half = cumulative[:, -1:] / 2
    lower = np.minimum((cumulative < half).sum(1), len(x) - 1)
    upper = np.minimum((cumulative <= half).sum(1), len(x) - 1)
    return np.asarray(np.where(half[:, 0] > 0, (x[lower] + x[upper]) / 2, np.nan))


def _interval(value: Float64Array, draws: Float64Array) -> Interval:
    draws = draws[np.isfinite(draws)]
    if len(draws) == 0 or not np.isfinite(value):
        return Interval(float(value), float("nan"), float("nan"))
    low, high = np.quantile(draws, [(1 - COVERAGE) / 2, (1 + COVERAGE) / 2])
    return Interval(float(value), float(low), float(high))
