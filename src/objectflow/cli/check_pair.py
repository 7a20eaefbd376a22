"""`objectflow check-pair`: check two frames for common input errors."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from tyro.conf import Positional

from objectflow.cli.arguments import CameraArguments, open_two, option
from objectflow.cli.findings import print_findings, verdict
from objectflow.diagnosis import examine
from objectflow.diagnosis.settings import DiagnosisSettings
from objectflow.runtime.quiet import silence_stderr
from objectflow.settings import build, parse_assignments

EXAMPLES = """\
  objectflow check-pair PAIR_DIR
  objectflow check-pair color0.png depth0.png color1.png depth1.png --intrinsics 615 615 320 240 --depth-scale 1000
"""


@dataclass(frozen=True)
class CheckPair(CameraArguments):
    """Check two RGB-D frames for common input errors.

    Checks depth units, registration, ray length, holes, swapped or identical frames, exposure, camera motion and the
    amount of motion. Writes nothing; the exit code is 0 whatever the findings.
    """

    paths: Annotated[Positional[tuple[Path, ...]], option("PAIR_DIR | COLOR0 DEPTH0 COLOR1 DEPTH1")]
    """A pair folder (color0, depth0, color1, depth1, camera.json) or four files; 0 = previous, 1 = current."""

    set: Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], option("PATH=VALUE", "none")] = ()
    """A threshold of the checks, such as depth.max_median_depth=20; may be repeated."""

    def run(self) -> None:
        """Read, check, print."""
        settings = build(DiagnosisSettings, parse_assignments(self.set))
        with silence_stderr():
            prev, curr = open_two(self.paths, self.camera_options())
            findings = examine(prev, curr, settings=settings)
        print_findings(findings)
        print(verdict(findings))
