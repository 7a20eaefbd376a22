"""The check of a data set: hashes, warped pairs and statistics, as tables and a verdict."""

from __future__ import annotations

import json
from pathlib import Path

from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from objectflow.dataset.check import CheckReport, check
from objectflow.errors import DatasetError


def is_set(path: Path) -> bool:
    """Whether a folder is a data set."""
    return (path / "manifest.json").is_file() or any(path.glob("*-of-*.parquet"))


def check_set(data: Path, *, limit: int | None, as_json: bool) -> None:
    """Check a data set and print one table per part and a verdict, or JSON.

    Raises:
        DatasetError: no data set, a shard whose hash differs, or inconsistent rows.
    """
    console = Console()
    with Progress(console=console, transient=True, disable=not console.is_terminal) as progress:
        bar = progress.add_task("warp")
        reports = check(
            data,
            limit=limit,
            report=lambda part, done, total: progress.update(bar, description=part, completed=done, total=total),
        )
    if as_json:
        print(json.dumps([report.to_dict() for report in reports], indent=2))
    else:
        for report in reports:
            _print(console, report)
    wrong = [line for report in reports for line in report.wrong]
    if wrong:
        raise DatasetError(f"{data}: {len(wrong)} rows are inconsistent, the first: {wrong[0]}")
    if not as_json:
        rows = sum(report.rows for report in reports)
        checked = "all pairs" if limit is None else f"up to {limit} pairs per part"
        console.print(f"verdict: nothing suspicious: the hashes of {rows} rows match, and {checked} are consistent")


def _print(console: Console, report: CheckReport) -> None:
    table = Table(title=f"{report.part}: {report.rows} rows, set {report.hash[:12]}")
    for column in ("quantity", "mean", "median", "95%", "count"):
        table.add_column(column, justify="left" if column == "quantity" else "right")
    quantities = (
        ("depth error, mm per pixel", report.depth_mm),
        ("depth error with reduced rotations, mm", report.reduced_depth_mm),
        ("colour error, grey levels", report.color),
        ("objects per pair", report.objects),
        ("visible pixels per object", report.visible),
        ("displacement, cm", report.displacement_cm),
        ("rotation (reduced), degrees", report.rotation_deg),
        ("rotation (raw), degrees", report.raw_rotation_deg),
    )
    for name, histogram in quantities:
        median, high = histogram.quantile(0.5), histogram.quantile(0.95)
        table.add_row(name, f"{histogram.mean:.2f}", f"{median:.2f}", f"{high:.2f}", str(histogram.count))
    console.print(table)
    share = 100 * report.symmetric / max(1, report.objects_total)
    rejected = ", ".join(f"{count} {reason}" for reason, count in report.rejected.items()) or "none"
    console.print(f"symmetric objects: {share:.0f}%; rejected scenes: {rejected}")
    if report.movers.count:
        pairs = report.movers.count
        console.print(
            f"moving objects per pair: {report.movers.mean:.2f}; pairs without motion: {report.motionless}/{pairs}; "
            f"pairs with a moving camera: {report.moving_cameras}/{pairs}"
        )
    for entry in report.worst[:3]:
        console.print(
            f"worst: {entry.key} object {entry.label} ({entry.model}): {entry.depth_mm:.2f} mm", markup=False
        )
