"""Findings of the checks as a table with the problems first, as a verdict, and as one line of warning."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from rich.console import Console
from rich.table import Table

from objectflow.diagnosis import Finding, Level, examine_quickly
from objectflow.frame import RgbdFrame

MARKS: dict[Level, str] = {"fine": "[green]fine", "note": "[yellow]note", "suspicious": "[bold red]suspicious"}
ORDER: tuple[Level, ...] = ("suspicious", "note", "fine")


def print_findings(findings: Sequence[Finding]) -> None:
    """Print a table of findings, problems first."""
    table = Table(show_edge=False)
    for column in ("check", "", "finding"):
        table.add_column(column, overflow="fold")
    for finding in sorted(findings, key=lambda finding: ORDER.index(finding.level)):
        table.add_row(finding.check, MARKS[finding.level], finding.text)
    Console().print(table)


def verdict(findings: Sequence[Finding]) -> str:
    """One line: the number of suspicious findings and their names."""
    names = [finding.check for finding in findings if finding.level == "suspicious"]
    return f"{len(names)} suspicious: {', '.join(dict.fromkeys(names))}" if names else "nothing suspicious"


def warn_of(prev: RgbdFrame, curr: RgbdFrame) -> None:
    """Print one line on standard error if units, registration or repeated images are suspicious."""
    findings = examine_quickly(prev, curr)
    if findings:
        text = "; ".join(f"{finding.check}: {finding.text}" for finding in findings)
        print(f"warning: {text} (`objectflow check` examines the source)", file=sys.stderr, flush=True)
