"""`report.html`: an evaluation as one self-contained file with tables, plots, a gallery and 3D views."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from objectflow.errors import ResultError
from objectflow.evaluation.results import Evaluation, PairSource
from objectflow.evaluation.tables.tables import make_tables
from objectflow.storage import files
from objectflow.view.report_page.assemble import assemble, escape, json_block
from objectflow.view.report_page.choice import choose_pairs
from objectflow.view.report_page.numbers import report_numbers
from objectflow.view.report_page.pair_block import make_pair_block
from objectflow.view.report_page.tables import failures_html, tables_html

MAX_PAIRS = 60
"""Default maximum number of pairs in the gallery; their size grows with the number of methods and the flow noise."""


def write_report(path: Path, evaluation: Evaluation, source: PairSource, *, max_pairs: int = MAX_PAIRS) -> None:
    """Write the report as one self-contained file, atomically; the same evaluation gives the same bytes.

    Args:
        path: of the HTML file.
        evaluation: the scores.
        source: the frames, truths and predictions of the pairs.
        max_pairs: maximum number of pairs in the gallery: the worst, the best and some between. 0 for none.

    Raises:
        ResultError: `max_pairs` is negative.
        DatasetError: a pair cannot be read.
        StorageError: the file cannot be written.
    """
    if max_pairs < 0:
        raise ResultError(f"the report's gallery cannot show {max_pairs} pairs: ask for 0 or more")
    chosen = choose_pairs(evaluation, max_pairs)
    title = f"objectflow evaluation: {evaluation.data}"
    tables = make_tables(evaluation)
    blocks = [json_block("report-data", report_numbers(evaluation, tables.tables, chosen))]
    blocks += [_pair_block(evaluation, source, position, index) for position, index in enumerate(chosen)]
    page = assemble(
        {
            "title": escape(title),
            "facts": _facts(evaluation),
            "tables": tables_html(tables),
            "gallery_note": escape(_gallery_note(evaluation, chosen)),
            "failures": failures_html(evaluation),
            "footer": escape(f"Written by objectflow {evaluation.version}. 3D views: three.js (MIT licence)."),
            "data": "\n".join(blocks),
        }
    )
    files.write_text(path, page)


def _pair_block(evaluation: Evaluation, source: PairSource, position: int, index: int) -> str:
    key = evaluation.pairs[index].key
    scores = {m: score for m, method in enumerate(evaluation.methods) if (score := method.score(key)) is not None}
    found = ((m, source.prediction(evaluation.methods[m].label, key)) for m in scores)
    predictions = {m: motion for m, motion in found if motion is not None}
    return json_block(f"pair-data-{position}", make_pair_block(source.pair(key), predictions, scores))


def _facts(evaluation: Evaluation) -> str:
    scenes = len({pair.scene for pair in evaluation.pairs})
    split = f", split {evaluation.split}" if evaluation.split else ""
    facts = [
        f"{escape(evaluation.data)} ({escape(evaluation.kind)}{escape(split)})",
        f"{len(evaluation.pairs)} of {evaluation.total} pairs, {scenes} scenes",
        f"sha256 <code>{escape(evaluation.sha256[:16])}</code>",
        escape(evaluation.machine),
        f"objectflow {escape(evaluation.version)}",
    ]
    return " &middot; ".join(facts)


def _gallery_note(evaluation: Evaluation, chosen: Sequence[int]) -> str:
    count = len(evaluation.pairs)
    if len(chosen) == count:
        return f"All {count} pairs."
    return (
        f"{len(chosen)} of {count} pairs: one third with the lowest and one third with the highest mean-F over the "
        "methods, the others spread evenly over the ranks between. Tables and plots cover all pairs."
    )
