"""`objectflow check`: verify a data set's hashes, and warp its pixels by its motions."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from rich.console import Console
from rich.progress import Progress
from rich.table import Table
from tyro.conf import Positional

from objectflow.cli.arguments import option
from objectflow.dataset.check import CheckReport, check
from objectflow.errors import DatasetError

EXAMPLES = """\
  objectflow check data
  objectflow check data --limit 100
  objectflow check data --json
"""


@dataclass(frozen=True)
class Check:
    """Verify every shard's hash, warp each pair by its depth, poses and motions, and print statistics of the set."""

    data: Annotated[Positional[Path], option("DIR")]
    """Folder of the data set."""

    limit: int | None = None
    """Maximum number of pairs to warp per part."""

    json: bool = False
    """Print the statistics as JSON."""

    def run(self) -> None:
        """Check, and print one table per part."""
        console = Console()
        with Progress(console=console, transient=True, disable=not console.is_terminal) as progress:
            bar = progress.add_task("warp")
            reports = check(
                self.data,
                limit=self.limit,
                report=lambda part, done, total: progress.update(bar, description=part, completed=done, total=total),
            )
        if self.json:
            print(json.dumps([report.to_dict() for report in reports], indent=2))
        else:
            for report in reports:
                _print(console, report)
        wrong = [line for report in reports for line in report.wrong]
        if wrong:
            raise DatasetError(f"{self.data}: {len(wrong)} rows are inconsistent, the first: {wrong[0]}")


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
