"""The paper's two tables with our rows beside the paper's, and further tables."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from objectflow.evaluation.metrics.flow_metrics import THRESHOLDS_CM
from objectflow.evaluation.results import Evaluation, MethodResult
from objectflow.evaluation.tables import paper_rows
from objectflow.evaluation.tables.breakdown import breakdown_tables
from objectflow.evaluation.tables.summary import FlowSummary, SegmentationSummary, Summary
from objectflow.evaluation.tables.table import Cell, Column, Row, Table

SHOWN_FAILURES = 3
"""Number of failures listed per method; the others are counted, and listed in results.json."""


@dataclass(frozen=True)
class Tables:
    """All tables of an evaluation, facts about the set, and notes to print with the tables."""

    facts: dict[str, str | int]
    tables: tuple[Table, ...]
    notes: tuple[str, ...]


def make_tables(evaluation: Evaluation) -> Tables:
    """Arrange the numbers of an evaluation in tables."""
    tables = [
        _flow_table(evaluation),
        _segmentation_table(evaluation),
        _motion_table(evaluation),
        _mover_table(evaluation),
        _more_flow_table(evaluation),
        _forms_table(evaluation),
        *breakdown_tables(evaluation),
    ]
    return Tables(_facts(evaluation), tuple(tables), _notes(evaluation))


def _flow_table(evaluation: Evaluation) -> Table:
    columns = (
        *_pairs_column(evaluation),
        Column("epe_all", "EPE all, cm", digits=2),
        Column("epe_masked", "EPE masked, cm", digits=2),
        Column("aae_all", "AAE all, deg", digits=2),
        Column("aae_masked", "AAE masked, deg", digits=2),
        Column("seconds", "s/pair"),
    )

    def cells(summary: Summary) -> dict[str, Cell]:
        return {
            "epe_all": Cell.of(summary.flow_all.epe_cm, summary.flow_all.epe_std),
            "epe_masked": Cell.of(summary.flow_masked.epe_cm, summary.flow_masked.epe_std),
            "aae_all": Cell.of(summary.flow_all.aae_deg, summary.flow_all.aae_std),
            "aae_masked": Cell.of(summary.flow_masked.aae_deg, summary.flow_masked.aae_std),
            "seconds": Cell(summary.runtime.median),
        }

    printed = [
        Row(
            row.method,
            "paper",
            {
                "epe_all": _as_printed(row.epe_all),
                "epe_masked": _as_printed(row.epe_masked),
                "aae_all": _as_printed(row.aae_all),
                "aae_masked": _as_printed(row.aae_masked),
                "seconds": Cell(text=row.seconds),
            },
        )
        for row in (() if evaluation.kind == "real" else paper_rows.FLOW)
    ]
    return Table("scene-flow", "Scene flow", columns, (*_rows(evaluation, cells), *printed), main=True)


def _segmentation_table(evaluation: Evaluation) -> Table:
    columns = (
        *_pairs_column(evaluation),
        Column("precision", "precision"),
        Column("recall", "recall"),
        Column("f", "F-measure"),
        Column("extracted", "extracted"),
        Column("share", "share", percent=True),
    )
    in_sequences = evaluation.kind == "sequences"
    true_objects = paper_rows.TEST_SEQ_OBJECTS if in_sequences else paper_rows.TEST_OBJECTS
    printed_rows: tuple[paper_rows.PaperSegmentation, ...] = paper_rows.TEST_SEQ if in_sequences else paper_rows.TEST
    if evaluation.kind == "real":
        printed_rows = ()
    printed = [
        Row(
            row.method,
            "paper",
            {
                "precision": Cell(row.precision),
                "recall": Cell(row.recall),
                "f": Cell(row.f),
                "extracted": Cell(row.extracted, total=true_objects),
                "share": Cell(row.extracted / true_objects),
            },
        )
        for row in printed_rows
    ]
    rows = (*_rows(evaluation, lambda summary: _form_cells(summary.mean_f)), *printed)
    name = "TestSeq" if in_sequences else "Test"
    return Table(
        "segmentation", f"Segmentation (mean-F; the paper's rows are those of {name})", columns, rows, main=True
    )


def _motion_table(evaluation: Evaluation) -> Table:
    columns = (
        Column("matched", "matched"),
        Column("rotation", "rotation error, deg", digits=2),
        Column("translation", "translation error, cm", digits=2),
        Column("good", "share", percent=True),
    )

    def cells(summary: Summary) -> dict[str, Cell]:
        return {
            "matched": Cell(summary.objects.matched, total=summary.mean_f.true_objects),
            "rotation": Cell.of(summary.objects.rotation_deg),
            "translation": Cell.of(summary.objects.translation_cm),
            "good": Cell.of(summary.objects.good),
        }

    return Table(
        "motions",
        "Motions of matched objects: median errors, share under 5 deg and 2 cm",
        columns,
        _rows(evaluation, cells),
        main=True,
    )


def _mover_table(evaluation: Evaluation) -> Table:
    """Printed in the terminal only if some pairs have no motion; in other sets nearly everything moves."""
    columns = (
        Column("found", "found"),
        Column("mover_precision", "precision"),
        Column("mover_recall", "recall"),
        Column("static_pairs", "pairs without motion"),
        Column("no_false_mover", "no false mover", percent=True),
    )

    def cells(summary: Summary) -> dict[str, Cell]:
        movers = summary.movers
        return {
            "found": Cell(movers.found, total=movers.true),
            "mover_precision": Cell.of(movers.precision),
            "mover_recall": Cell.of(movers.recall),
            "static_pairs": Cell(movers.static_pairs, total=summary.pairs),
            "no_false_mover": Cell.of(movers.no_false_mover),
        }

    some_static = any(
        method.summary is not None and method.summary.movers.static_pairs for method in evaluation.methods
    )
    title = "Moving objects, found with F >= 0.75; no false mover: share of the pairs without motion"
    return Table("movers", title, columns, _rows(evaluation, cells), main=some_static)


def _more_flow_table(evaluation: Evaluation) -> Table:
    limits = [f"{limit:g}" for limit in THRESHOLDS_CM]
    columns = (
        Column("epe_moving", "EPE moving, cm", digits=2),
        Column("aae_moving", "AAE moving, deg", digits=2),
        *(Column(f"masked_{limit}", f"masked, under {limit} cm", percent=True) for limit in limits),
        *(Column(f"moving_{limit}", f"moving, under {limit} cm", percent=True) for limit in limits),
        Column("density", "density", percent=True),
    )

    def shares(name: str, flow: FlowSummary) -> dict[str, Cell]:
        return {f"{name}_{limit}": Cell.of(share) for limit, share in zip(limits, flow.under, strict=True)}

    def cells(summary: Summary) -> dict[str, Cell]:
        moving = summary.flow_moving
        return {
            "epe_moving": Cell.of(moving.epe_cm, moving.epe_std),
            "aae_moving": Cell.of(moving.aae_deg, moving.aae_std),
            **shares("masked", summary.flow_masked),
            **shares("moving", moving),
            "density": Cell.of(summary.flow_all.density),
        }

    title = "Scene flow, shares of pixels; moving: on objects that move"
    return Table("scene-flow-shares", title, columns, _rows(evaluation, cells))


def _forms_table(evaluation: Evaluation) -> Table:
    forms: dict[str, Callable[[Summary], SegmentationSummary]] = {
        "FBMS": lambda summary: summary.fbms,
        "overlap": lambda summary: summary.overlap,
        "boundary": lambda summary: summary.boundary,
    }
    columns = tuple(
        Column(f"{form}_{part}", f"{form} {heading}")
        for form in forms
        for part, heading in (("precision", "P"), ("recall", "R"), ("f", "F"), ("extracted", "extracted"))
        if (form, part) != ("boundary", "extracted")
    )

    def cells(summary: Summary) -> dict[str, Cell]:
        return {f"{form}_{part}": cell for form in forms for part, cell in _form_cells(forms[form](summary)).items()}

    return Table("segmentation-forms", "Segmentation, the other forms", columns, _rows(evaluation, cells))


def _as_printed(mean_and_deviation: tuple[float, float]) -> Cell:
    """Mean and deviation with the paper's digits."""
    mean, deviation = mean_and_deviation
    return Cell(mean, std=deviation, text=f"{mean:.3f} ±{deviation:.2f}")


def _form_cells(form: SegmentationSummary) -> dict[str, Cell]:
    return {
        "precision": Cell.of(form.precision),
        "recall": Cell.of(form.recall),
        "f": Cell.of(form.f),
        "extracted": Cell(form.extracted, total=form.true_objects),
        "share": Cell.of(form.extracted_share),
    }


def _rows(evaluation: Evaluation, cells: Callable[[Summary], dict[str, Cell]]) -> tuple[Row, ...]:
    def row(method: MethodResult) -> Row:
        pairs = {"pairs": Cell(len(method.scores), total=len(evaluation.pairs))}
        own = {} if method.summary is None else cells(method.summary)
        return Row(method.label, "oracle" if method.oracle else "ours", {**pairs, **own})

    return tuple(row(method) for method in evaluation.methods)


def _pairs_column(evaluation: Evaluation) -> tuple[Column, ...]:
    """A column with the number of scored pairs, if any method failed on some."""
    return (Column("pairs", "pairs"),) if any(method.failures for method in evaluation.methods) else ()


def _facts(evaluation: Evaluation) -> dict[str, str | int]:
    return {
        "data": evaluation.data,
        "kind": evaluation.kind,
        "split": evaluation.split,
        "sha256": evaluation.sha256,
        "pairs": len(evaluation.pairs),
        "of": evaluation.total,
        "scenes": len({pair.scene for pair in evaluation.pairs}),
        "machine": evaluation.machine,
        "objectflow": evaluation.version,
    }


def _notes(evaluation: Evaluation) -> tuple[str, ...]:
    facts = _facts(evaluation)
    split = f", {facts['kind']} of split {facts['split']}" if facts["split"] else ""
    notes = [
        f"{facts['pairs']} of {facts['of']} pairs ({facts['scenes']} scenes) of {facts['data']}{split}, sha256 "
        f"{str(facts['sha256'])[:16]}; objectflow {facts['objectflow']}.",
        "± is the standard deviation over images; [ ] is the 95% bootstrap interval over scenes.",
    ]
    if evaluation.kind != "real":
        notes.append(f"(paper): {paper_rows.SOURCE}; not to be compared as if they were on these pairs.")
    runs: dict[str, list[str]] = {}
    for method in evaluation.methods:
        if method.summary is not None:
            runs.setdefault(method.summary.runtime.machine, []).append(method.label)
    notes += [
        f"Seconds are medians, warmed up, on {machine} ({', '.join(labels)})." for machine, labels in runs.items()
    ]
    if any(method.oracle for method in evaluation.methods):
        notes.append("† sees the truth: oracles show where errors come from and are not competitors.")
    notes += [_failures(method, len(evaluation.pairs)) for method in evaluation.methods if method.failures]
    return tuple(notes)


def _failures(method: MethodResult, pairs: int) -> str:
    named = "; ".join(f"{one.key}: {one.reason}" for one in method.failures[:SHOWN_FAILURES])
    more = len(method.failures) - SHOWN_FAILURES
    rest = f"; and {more} more" if more > 0 else ""
    return f"{method.label} failed on {len(method.failures)} of {pairs} pairs, left out of its means: {named}{rest}."
