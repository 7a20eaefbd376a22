"""Mask and flow scores by number of objects, displacement, rotation, visible pixels and symmetry."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from objectflow.evaluation.metrics.pair_score import PairScore
from objectflow.evaluation.metrics.region_scores import RegionScore
from objectflow.evaluation.results import Evaluation, MethodResult, ObjectFacts, PairFacts
from objectflow.evaluation.tables.bootstrap import Bootstrap
from objectflow.evaluation.tables.table import Cell, Column, Row, Table

SEED = 0
"""Seed of the bootstrap."""

_OPEN = math.inf


@dataclass(frozen=True)
class Breakdown:
    """A property by which objects are binned. Bins are [edge, next edge); the last one is open.

    Attributes:
        name, title: short name, and printed title.
        edges: of the bins, increasing.
        of: the value of an object in its pair.
        names: of the bins, if not given by the edges.
        whole: whether values are whole numbers.
    """

    name: str
    title: str
    edges: tuple[float, ...]
    of: Callable[[ObjectFacts, PairFacts], float]
    names: tuple[str, ...] = ()
    whole: bool = False

    def heading(self, number: int) -> str:
        """The printed name of a bin."""
        if self.names:
            return self.names[number]
        low, high = self.edges[number], (*self.edges, _OPEN)[number + 1]
        return f"{low:g}+" if high == _OPEN else f"{low:g}-{high - self.whole:g}"

    def bin(self, value: float) -> int | None:
        """The number of a value's bin; None for NaN."""
        return None if math.isnan(value) else int(np.searchsorted(self.edges, value, side="right")) - 1


BREAKDOWNS = (
    Breakdown("objects", "objects in the image", (1, 4, 8, 12, 20), lambda _, pair: pair.number, whole=True),
    Breakdown("displacement", "displacement, cm", (0, 2, 5, 10, 20), lambda obj, _: obj.displacement_cm),
    Breakdown("rotation", "rotation, deg", (0, 5, 15, 45, 90), lambda obj, _: obj.rotation_deg),
    Breakdown("pixels", "visible pixels", (1, 100, 300, 1000, 3000), lambda obj, _: obj.pixels, whole=True),
    Breakdown("symmetry", "symmetry", (0, 1), lambda obj, _: obj.symmetric, ("none", "symmetric")),
)


@dataclass(frozen=True)
class _Measure:
    name: str
    title: str
    of: Callable[[RegionScore], float]
    digits: int


_MEASURES = (
    _Measure("f", "Mean F-measure of objects", lambda region: region.f, 3),
    _Measure("epe", "Mean EPE of objects, cm", lambda region: region.epe_cm, 2),
)


def breakdown_tables(evaluation: Evaluation) -> list[Table]:
    """A table for each measure and breakdown, over objects visible in both frames, with equal weights."""
    return [_table(evaluation, breakdown, measure) for breakdown in BREAKDOWNS for measure in _MEASURES]


def _table(evaluation: Evaluation, breakdown: Breakdown, measure: _Measure) -> Table:
    bins = {pair.key: _bins_of(pair, breakdown) for pair in evaluation.pairs}
    counts = np.bincount(
        [number for of_pair in bins.values() for number in of_pair.values()], minlength=len(breakdown.edges)
    )
    columns = tuple(
        Column(f"bin_{number}", f"{breakdown.heading(number)} (n={counts[number]})", digits=measure.digits)
        for number in range(len(breakdown.edges))
    )
    rows = tuple(
        Row(
            method.label,
            "oracle" if method.oracle else "ours",
            {
                column.name: cell
                for column, cell in zip(columns, _cells(method, bins, measure, len(columns)), strict=True)
            },
        )
        for method in evaluation.methods
    )
    return Table(f"{measure.name}-by-{breakdown.name}", f"{measure.title}, by {breakdown.title}", columns, rows)


def _bins_of(pair: PairFacts, breakdown: Breakdown) -> dict[int, int]:
    """Label -> number of the bin, for the objects visible in both frames."""
    found = {obj.label: breakdown.bin(breakdown.of(obj, pair)) for obj in pair.objects if obj.in_both}
    return {label: number for label, number in found.items() if number is not None}


def _cells(method: MethodResult, bins: dict[str, dict[int, int]], measure: _Measure, count: int) -> Sequence[Cell]:
    if not method.scores:
        return [Cell()] * count
    sums, counts = np.zeros((len(method.scores), count)), np.zeros((len(method.scores), count))
    for row, score in enumerate(method.scores):
        for number, value in _values(score, bins[score.key], measure):
            sums[row, number] += value
            counts[row, number] += 1
    bootstrap = Bootstrap([score.scene for score in method.scores], np.random.default_rng(SEED))
    return [Cell.of(bootstrap.ratio(sums[:, number], counts[:, number])) for number in range(count)]


def _values(score: PairScore, bins: dict[int, int], measure: _Measure) -> list[tuple[int, float]]:
    found = [(bins[region.label], measure.of(region)) for region in score.regions if region.label in bins]
    return [(number, value) for number, value in found if not math.isnan(value)]
