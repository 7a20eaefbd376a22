"""The tables as HTML: every cell shows a rounded number and holds the exact number in its attributes."""

from __future__ import annotations

import math

from objectflow.evaluation.results import Evaluation
from objectflow.evaluation.tables.table import Cell, Column, Row, Table, write_interval, write_value
from objectflow.evaluation.tables.tables import Tables
from objectflow.view.report_page.assemble import escape

_LOWER_IS_BETTER = ("epe", "aae", "rotation", "translation", "seconds")
"""Prefixes of column names in which lower numbers are better."""
_NOT_RANKED = ("pairs", "matched")
"""Columns without a best number."""
_SECTIONS = (
    ("flow", "Scene flow", ("scene-flow",), ("scene-flow-shares",)),
    ("segmentation", "Segmentation and motions", ("segmentation", "motions"), ("segmentation-forms",)),
)


def tables_html(tables: Tables) -> str:
    """The sections with tables, without the breakdowns, which are drawn as plots."""
    remaining = {table.name: table for table in tables.tables if "-by-" not in table.name}
    sections = []
    for name, title, shown, folded in _SECTIONS:
        visible = [remaining.pop(key) for key in shown if key in remaining]
        more = [remaining.pop(key) for key in folded if key in remaining]
        if name == "segmentation":  # Takes all remaining tables.
            more += remaining.values()
        parts = [_table(table, "" if table.title == title else table.title) for table in visible]
        parts += [f"<details><summary>{escape(table.title)}</summary>{_table(table, '')}</details>" for table in more]
        head = f'<h2 id="{name}-title">{title}</h2>'
        sections.append(f'<section id="{name}" aria-labelledby="{name}-title">{head}{"".join(parts)}</section>')
    notes = "".join(f"<li>{escape(note)}</li>" for note in tables.notes)
    return "\n".join([*sections, f'<section id="notes" aria-label="Notes"><ul class="notes">{notes}</ul></section>'])


def failures_html(evaluation: Evaluation) -> str:
    """A section that lists every pair on which a method failed; empty if there is none."""
    parts = []
    for method in evaluation.methods:
        if method.failures:
            items = "".join(f"<li><code>{escape(f.key)}</code>: {escape(f.reason)}</li>" for f in method.failures)
            head = f"{escape(method.label)}: {len(method.failures)} of {len(evaluation.pairs)} pairs failed"
            parts.append(f"<details><summary>{head}</summary><ul>{items}</ul></details>")
    if not parts:
        return ""
    title = '<h2 id="failures-title">Failures</h2>'
    return f'<section class="failures" aria-labelledby="failures-title">{title}{"".join(parts)}</section>'


def _table(table: Table, caption: str) -> str:
    heads = "".join(f'<th scope="col">{escape(column.heading)}</th>' for column in table.columns)
    best = {column.name: _best(table, column) for column in table.columns}
    rows = "".join(_row(row, table.columns, best) for row in table.rows)
    name, title = escape(table.name), escape(table.title)
    return (
        f'<div class="scroll" tabindex="0" role="region" aria-label="{title}"><table id="table-{name}">'
        f"<caption>{escape(caption)}</caption>"
        f'<thead><tr><th scope="col">method</th>{heads}</tr></thead><tbody>{rows}</tbody></table></div>'
    )


def _row(row: Row, columns: tuple[Column, ...], best: dict[str, str | None]) -> str:
    cells = "".join(_cell(row.cells.get(column.name), column, row, best[column.name]) for column in columns)
    head = f'<th scope="row">{escape(row.title)}</th>'
    return f'<tr class="{row.origin}" data-method="{escape(row.label)}">{head}{cells}</tr>'


def _cell(cell: Cell | None, column: Column, row: Row, best: str | None) -> str:
    shown, interval = write_value(cell, column), write_interval(cell, column)
    exact = "".join(
        f' data-{name}="{value!r}"'
        for name in ("value", "low", "high", "std")
        if cell is not None and math.isfinite(value := float(getattr(cell, name)))
    )
    kind = ' class="best"' if best is not None and row.origin == "ours" and shown.split(" ")[0] == best else ""
    small = f"<small>{escape(interval)}</small>" if interval else ""
    return f'<td data-column="{escape(column.name)}"{kind}{exact}>{escape(shown)}{small}</td>'


def _best(table: Table, column: Column) -> str | None:
    """The best number among the methods of the evaluation, as printed; None if there are fewer than two."""
    if column.name in _NOT_RANKED:
        return None
    cells = [row.cells.get(column.name) for row in table.rows if row.origin == "ours"]
    known = [cell for cell in cells if cell is not None and math.isfinite(cell.value)]
    if len(known) < 2:
        return None
    pick = min if column.name.startswith(_LOWER_IS_BETTER) else max
    return write_value(pick(known, key=lambda cell: cell.value), column).split(" ")[0]
