"""`objectflow check`: verify a recording or a data set before it is used."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from tyro.conf import Positional

from objectflow.cli.arguments import SourceArguments, option
from objectflow.cli.check_set import check_set, is_set
from objectflow.cli.findings import print_findings, verdict
from objectflow.diagnosis import draw_depth_edges, examine, examine_source, read_pair
from objectflow.diagnosis.settings import DiagnosisSettings
from objectflow.errors import CheckError, DatasetError
from objectflow.readers import CutOffWarning
from objectflow.runtime.quiet import silence_stderr
from objectflow.settings import build, parse_assignments
from objectflow.storage import files
from objectflow.storage.images import encode_png

EXAMPLES = """\
  objectflow check recording
  objectflow check table.bag --pair 10 20 --picture edges.png
  objectflow check rgbd_dataset_freiburg1_desk --camera-file fr1 --strict
  objectflow check data
  objectflow check data --limit 100 --json
"""


@dataclass(frozen=True)
class Check(SourceArguments):
    """Check a source of `objectflow run` for common input errors, or verify a data set.

    Of a source, two frames are examined as by `check-pair`, and all frames for missing files, repeated images and
    irregular times. Of a data set, every shard's hash is verified and each pair is warped by its depth, poses and
    motions.
    """

    source: Annotated[Positional[Path], option("SOURCE | DATA_DIR")]
    """A pair folder, a sequence, a bag, or the folder of a data set; the kind is detected."""

    pair: Annotated[tuple[int, int] | None, option("I J", "two frames in the middle")] = None
    """The frames of a source to examine, numbered from 0."""

    picture: Annotated[Path | None, option("FILE.png", "none")] = None
    """Picture to write: the depth edges of the second frame over its colour."""

    set: Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], option("PATH=VALUE", "none")] = ()
    """A threshold of the checks, such as depth.max_median_depth=20; may be repeated."""

    strict: bool = False
    """Exit with code 1 if anything in a source is suspicious."""

    limit: int | None = None
    """Maximum number of pairs of a data set to warp per part."""

    json: bool = False
    """Print the statistics of a data set as JSON."""

    def run(self) -> None:
        """Check, print the problems first, and end with a verdict."""
        if is_set(self.source):
            if self.pair is not None or self.picture is not None:
                raise DatasetError(f"{self.source}: --pair and --picture are for sources, and this is a data set")
            check_set(self.source, limit=self.limit, as_json=self.json)
            return
        if self.limit is not None or self.json:
            raise DatasetError(f"{self.source}: --limit and --json are for data sets: there is no manifest.json")
        settings = build(DiagnosisSettings, parse_assignments(self.set))
        with silence_stderr(), warnings.catch_warnings():
            warnings.simplefilter("ignore", CutOffWarning)  # the notes say the same
            source = self.open_path(self.source)
            pair = read_pair(source, self.pair, settings=settings.source)
            findings = examine_source(source, settings=settings.source)
            findings += examine(pair.prev, pair.curr, settings=settings)
        if self.picture is not None:
            files.write_bytes(self.picture, encode_png(draw_depth_edges(pair.curr)))
        print(f"{self.source}: {len(source)} frames, {source.camera}; frames {pair.prev_index} and {pair.curr_index}:")
        print_findings(findings)
        if self.picture is not None:
            print(f"written to {self.picture}")
        conclusion = verdict(findings)
        if self.strict and any(finding.level == "suspicious" for finding in findings):
            raise CheckError(f"{self.source}: {conclusion}")
        print(f"verdict: {conclusion}")
