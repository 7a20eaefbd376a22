"""Tables as rich text, Markdown, CSV and JSON."""

from __future__ import annotations

import csv
import io
import json
import math

from rich.console import Console
from rich.table import Table as RichTable
from rich.text import Text

from objectflow.evaluation.tables.table import Table, write_interval, write_value
from objectflow.evaluation.tables.tables import Tables
from objectflow.storage.serialize import to_plain

WIDE = 100
"""Minimum width in columns of a terminal in which intervals are printed."""

_CSV_COLUMNS = ("table", "row", "origin", "column", "value", "low", "high", "std", "total", "text")


def print_tables(tables: Tables, console: Console) -> None:
    """Print the main tables and the notes; without intervals in narrow terminals."""
    wide = console.width >= WIDE
    for table in tables.tables:
        if table.main:
            console.print(table.title, style="italic", markup=False, highlight=False)
            console.print(_rich(table, intervals=wide))
            console.print()
    for note in tables.notes:
        console.print(note, markup=False, highlight=False)
    if not wide:
        console.print(f"Intervals are printed on terminals of {WIDE} columns, and are in the files.")


def to_markdown(tables: Tables, *, main_only: bool = False) -> str:
    """The tables with their notes as a Markdown document."""
    parts = [_markdown(table) for table in tables.tables if table.main or not main_only]
    notes = "\n".join(f"- {_escape(note)}" for note in tables.notes)
    return "\n".join([*parts, notes, ""])


def to_csv(tables: Tables) -> str:
    """One line per number: table, row, column, value, interval, deviation, and the facts about the set."""
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow([*_CSV_COLUMNS, *tables.facts])
    for table in tables.tables:
        for row in table.rows:
            for column in table.columns:
                cell = row.cells.get(column.name)
                if cell is None:
                    continue
                numbers = [_plain(number) for number in (cell.value, cell.low, cell.high, cell.std)]
                total = "" if cell.total is None else cell.total
                writer.writerow(
                    [
                        table.name,
                        row.label,
                        row.origin,
                        column.name,
                        *numbers,
                        total,
                        cell.text,
                        *tables.facts.values(),
                    ]
                )
    return buffer.getvalue()


def to_json(tables: Tables) -> str:
    """`{"facts", "notes", "tables": [{"name", "title", "columns", "rows": [{"label", "origin", "cells"}]}]}`."""
    return json.dumps(to_plain(tables), indent=1, allow_nan=False, ensure_ascii=False) + "\n"


def _rich(table: Table, *, intervals: bool) -> RichTable:
    drawn = RichTable(box=None, pad_edge=False, header_style="bold")
    drawn.add_column("method", no_wrap=True)
    for column in table.columns:
        drawn.add_column(column.heading, justify="right")
    for row in table.rows:
        texts = []
        for column in table.columns:
            cell = row.cells.get(column.name)
            text = Text(write_value(cell, column))
            interval = write_interval(cell, column)
            if interval and intervals:
                text.append(f"\n{interval}", style="dim")
            texts.append(text)
        drawn.add_row(Text(row.title), *texts, style="dim" if row.origin == "paper" else "")
    return drawn


def _markdown(table: Table) -> str:
    lines = [f"**{table.title}**", "", "| method | " + " | ".join(column.heading for column in table.columns) + " |"]
    lines.append("|---" * (len(table.columns) + 1) + "|")
    for row in table.rows:
        cells = []
        for column in table.columns:
            cell = row.cells.get(column.name)
            cells.append(f"{write_value(cell, column)} {write_interval(cell, column)}".strip())
        lines.append("| " + " | ".join([_escape(row.title), *cells]) + " |")
    return "\n".join([*lines, ""])


def _escape(text: str) -> str:
    return text.replace("|", "\\|")


def _plain(number: float) -> str:
    return "" if math.isnan(number) else repr(float(number))
