"""The numbers that the page's scripts sort and plot: scores of every pair, and breakdowns."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from objectflow.evaluation.metrics.pair_score import PairScore
from objectflow.evaluation.results import Evaluation, PairFacts
from objectflow.evaluation.tables.breakdown import BREAKDOWNS, Breakdown
from objectflow.evaluation.tables.table import Cell, Table

Best = Literal["low", "high"]


@dataclass(frozen=True)
class Metric:
    """A score of a pair; `short` is its abbreviated name."""

    id: str
    name: str
    short: str
    unit: str
    digits: int
    best: Best
    value: Callable[[PairScore], float]


METRICS: tuple[Metric, ...] = (
    Metric("mean_f", "mean-F", "F", "", 3, "high", lambda s: s.segmentation.mean_f.f),
    Metric("epe_masked", "EPE on objects", "EPE", "cm", 2, "low", lambda s: s.flow.masked.epe_cm),
    Metric("epe_all", "EPE on all pixels", "EPE all", "cm", 2, "low", lambda s: s.flow.all.epe_cm),
    Metric("aae_masked", "AAE on objects", "AAE", "°", 2, "low", lambda s: s.flow.masked.aae_deg),
    Metric("overlap_f", "F of UOIS overlap", "F UOIS", "", 3, "high", lambda s: s.segmentation.overlap.f),
    Metric("seconds", "seconds", "time", "s", 3, "low", lambda s: s.seconds),
)


_PLOTTED = (("f", "", 3, "high"), ("epe", "cm", 2, "low"))
"""Metrics of the breakdown plots: name, unit, decimal digits, and whether high or low is better."""


def report_numbers(evaluation: Evaluation, tables: Sequence[Table], chosen: Sequence[int]) -> dict[str, Any]:
    """The JSON that all scripts read.

    Args:
        evaluation: the scores.
        tables: of the evaluation; those of the breakdowns are drawn as plots.
        chosen: indices of the gallery's pairs.
    """
    named = {table.name: table for table in tables}
    scored = [{score.key: score for score in method.scores} for method in evaluation.methods]
    return {
        "methods": [{"name": method.label, "oracle": method.oracle} for method in evaluation.methods],
        "metrics": [
            {"id": m.id, "name": m.name, "short": m.short, "unit": m.unit, "digits": m.digits, "best": m.best}
            for m in METRICS
        ],
        "plots": [
            {
                "id": name,
                "name": named[f"{name}-by-objects"].title.split(",")[0],
                "unit": unit,
                "digits": digits,
                "best": best,
            }
            for name, unit, digits, best in _PLOTTED
        ],
        "breakdowns": [_breakdown(breakdown, named) for breakdown in BREAKDOWNS],
        "pairs": [
            {
                "key": pair.key,
                "scene": pair.scene,
                "facts": caption(pair),
                "scores": [_scores(table.get(pair.key)) for table in scored],
            }
            for pair in (evaluation.pairs[index] for index in chosen)
        ],
    }


def caption(pair: PairFacts) -> str:
    """Number of objects, displacement and rotation of a pair, for display."""
    moving = sum(obj.moving for obj in pair.objects)
    parts = [f"{pair.number} object{'' if pair.number == 1 else 's'}, {moving} moving"]
    if math.isfinite(pair.displacement_cm):
        parts.append(f"{pair.displacement_cm:.1f} cm")
    if math.isfinite(pair.rotation_deg):
        parts.append(f"{pair.rotation_deg:.0f}°")
    return " · ".join(parts)


def _breakdown(breakdown: Breakdown, named: Mapping[str, Table]) -> dict[str, Any]:
    tables = {name: named[f"{name}-by-{breakdown.name}"] for name, *_ in _PLOTTED}
    columns = tables["f"].columns
    groups = [breakdown.heading(k) for k in range(len(columns))]
    return {
        "name": breakdown.title,
        "groups": groups,
        "counts": [c.heading.removeprefix(group).strip(" ()") for c, group in zip(columns, groups, strict=True)],
        "values": {
            name: [[_interval(row.cells.get(column.name)) for column in table.columns] for row in table.rows]
            for name, table in tables.items()
        },
    }


def _interval(cell: Cell | None) -> list[float | None] | None:
    return None if cell is None else [finite(cell.value), finite(cell.low), finite(cell.high)]


def finite(value: float) -> float | None:
    """The value, or None (JSON null) if it is not finite."""
    return value if math.isfinite(value) else None


def _scores(score: PairScore | None) -> list[float | None] | None:
    return None if score is None else [finite(metric.value(score)) for metric in METRICS]
