"""`objectflow check-pair`: what may be wrong with two frames, in plain words."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from rich.console import Console
from rich.table import Table
from tyro.conf import Positional

from objectflow.cli.arguments import CameraArguments, open_two, option
from objectflow.cli.output import quiet_libraries
from objectflow.diagnosis import Level, examine

EXAMPLES = """\
  objectflow check-pair PAIR_DIR
  objectflow check-pair color0.png depth0.png color1.png depth1.png --intrinsics 615 615 320 240 --depth-scale 1000
"""

MARKS: dict[Level, str] = {"fine": "[green]fine", "note": "[yellow]note", "suspicious": "[bold red]suspicious"}


@dataclass(frozen=True)
class CheckPair(CameraArguments):
    """Look at two RGB-D frames and say what is suspicious.

    Units, unregistered depth, ray length, holes, swapped or identical frames, exposure, a moving camera, too much or
    too little motion. Writes nothing; the exit code is 0 whatever was found.
    """

    paths: Annotated[Positional[tuple[Path, ...]], option("PAIR_DIR | COLOR0 DEPTH0 COLOR1 DEPTH1")]
    """A pair folder (color0, depth0, color1, depth1, camera.json), or four files; 0 = previous, 1 = current."""

    def run(self) -> None:
        """Read, look, print."""
        with quiet_libraries():
            prev, curr = open_two(self.paths, self.camera_options())
            findings = examine(prev, curr)
        table = Table(show_edge=False)
        for column in ("check", "", "what was seen"):
            table.add_column(column, overflow="fold")
        for finding in findings:
            table.add_row(finding.check, MARKS[finding.level], finding.text)
        console = Console()
        console.print(table)
        count = sum(finding.level == "suspicious" for finding in findings)
        console.print(f"{count} suspicious" if count else "nothing suspicious")
