"""A table of numbers with their intervals, independent of its output as text, Markdown, CSV or JSON."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from objectflow.evaluation.tables.bootstrap import Interval

Origin = Literal["ours", "oracle", "paper"]

MARKS: dict[Origin, str] = {"ours": "", "oracle": " †", "paper": " (paper)"}
"""Suffixes of the labels of rows that are not comparable with the others."""


@dataclass(frozen=True)
class Column:
    """A column; its numbers have `digits` decimals, or are percentages."""

    name: str
    heading: str
    digits: int = 3
    percent: bool = False


@dataclass(frozen=True)
class Cell:
    """One number.

    Attributes:
        value: NaN if it is undefined; a share 0..1 in a column of percentages.
        low, high: the 95% interval; NaN if there is none.
        std: standard deviation over images; NaN if it is not reported.
        total: the total if the value is a count out of it, otherwise None.
        text: printed instead of the value, such as ">= 1".
    """

    value: float = math.nan
    low: float = math.nan
    high: float = math.nan
    std: float = math.nan
    total: int | None = None
    text: str = ""

    @classmethod
    def of(cls, interval: Interval, std: float = math.nan) -> Cell:
        """A cell of a statistic with its interval."""
        return cls(interval.value, interval.low, interval.high, std)


@dataclass(frozen=True)
class Row:
    """A method's cells by the names of the columns; a missing cell prints as a dash."""

    label: str
    origin: Origin
    cells: dict[str, Cell]

    @property
    def title(self) -> str:
        """The label with its mark."""
        return self.label + MARKS[self.origin]


@dataclass(frozen=True)
class Table:
    """A table; `name` is short and unique, and `main` tables are also printed in the terminal."""

    name: str
    title: str
    columns: tuple[Column, ...]
    rows: tuple[Row, ...]
    main: bool = False


def write_value(cell: Cell | None, column: Column) -> str:
    """The value as text: "4.29 ±2.93", "43719/64556", or a dash."""
    if cell is None or (math.isnan(cell.value) and not cell.text):
        return "-"
    if cell.text:
        return cell.text
    if cell.total is not None:
        return f"{cell.value:.0f}/{cell.total}"
    std = "" if math.isnan(cell.std) else f" ±{_number(cell.std, column)}"
    return f"{_number(cell.value, column)}{'%' if column.percent else ''}{std}"


def write_interval(cell: Cell | None, column: Column) -> str:
    """The interval as text, "[4.10, 4.52]", or an empty string."""
    if cell is None or cell.total is not None or math.isnan(cell.low):
        return ""
    return f"[{_number(cell.low, column)}, {_number(cell.high, column)}]"


def _number(value: float, column: Column) -> str:
    return f"{100 * value:.0f}" if column.percent else f"{value:.{column.digits}f}"
