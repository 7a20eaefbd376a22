"""`objectflow check`: verify a data set, and warp its pixels by its motions."""

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
    """Verify every shard's hash, warp each pair by its own depth, poses and motions, and say what is in the set."""

    data: Annotated[Positional[Path], option("DIR")]
    """Folder of the data set."""

    limit: int | None = None
    """Warp no more than this many pairs of each part."""

    json: bool = False
    """Print numbers for programs."""

    def run(self) -> None:
        """Check, and print a table a part."""
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
            raise DatasetError(f"{self.data}: {len(wrong)} rows contradict themselves, the first: {wrong[0]}")


def _print(console: Console, report: CheckReport) -> None:
    table = Table(title=f"{report.part}: {report.rows} rows, set {report.hash[:12]}")
    for column in ("what", "mean", "median", "95%", "count"):
        table.add_column(column, justify="left" if column == "what" else "right")
    named = (
        ("depth error, mm a pixel", report.depth_mm),
        ("depth error with reduced rotations, mm", report.reduced_depth_mm),
        ("colour error, grey levels", report.color),
        ("objects a pair", report.objects),
        ("visible pixels an object", report.visible),
        ("displacement, cm", report.displacement_cm),
        ("rotation (reduced), degrees", report.rotation_deg),
        ("rotation (raw), degrees", report.raw_rotation_deg),
    )
    for name, histogram in named:
        low, high = histogram.quantile(0.5), histogram.quantile(0.95)
        table.add_row(name, f"{histogram.mean:.2f}", f"{low:.2f}", f"{high:.2f}", str(histogram.count))
    console.print(table)
    share = 100 * report.symmetric / max(1, report.objects_total)
    redrawn = ", ".join(f"{count} {reason}" for reason, count in report.rejected.items()) or "none"
    console.print(f"symmetric objects: {share:.0f}%; drafts drawn anew: {redrawn}")
    if report.movers.count:
        pairs = report.movers.count
        console.print(
            f"moving objects a pair: {report.movers.mean:.2f}; pairs without motion: {report.motionless}/{pairs}; "
            f"before a moving camera: {report.moving_cameras}/{pairs}"
        )
    for entry in report.worst[:3]:
        console.print(
            f"worst: {entry.key} object {entry.label} ({entry.model}): {entry.depth_mm:.2f} mm", markup=False
        )
