"""`objectflow evaluate`: run methods on a set with known truth; write tables and a report."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
from rich.progress import Progress as Bar

from objectflow.cli.arguments import option
from objectflow.cli.output import OUTPUT_ROOT, check_not_below_a_file
from objectflow.errors import DatasetError, MethodError, ResultError
from objectflow.evaluation.data.sources import PairSet, SequenceUse, open_set
from objectflow.evaluation.methods import parse_methods
from objectflow.evaluation.predict import FOLDER, PredictionProgress, predict
from objectflow.evaluation.results import Evaluation
from objectflow.evaluation.score import CachedPairs, score
from objectflow.evaluation.tables.table_text import print_tables, to_csv, to_json, to_markdown
from objectflow.evaluation.tables.tables import Tables, make_tables
from objectflow.storage import files
from objectflow.storage.temporaries import sweep

EXAMPLES = """\
  objectflow evaluate --data tiny --methods rigidmatch consensus zero
  objectflow evaluate --data data --split test --limit 200 --methods rigidmatch consensus zero --out table
  objectflow evaluate --data data --sequences --methods rigidmatch consensus
  objectflow evaluate --data data --sensor structured-light --methods rigidmatch
  objectflow evaluate --data real:recordings --methods rigidmatch consensus zero --translation-only ball
  objectflow evaluate --data tiny --methods consensus quick=consensus:rounds=1,match_width=320
"""


@dataclass(frozen=True)
class Evaluate:
    """Run methods on pairs with truth and print the paper's two tables, with the rows of the paper for comparison.

    Predictions are cached in predictions/<method>/<pair>.npz and scored from there: the same command continues an
    interrupted run, and further methods or pairs can be added to it. Writes tables.md, tables.csv, tables.json,
    results.json and report.html.
    """

    data: Annotated[str, option("DIR|tiny|real:DIR")]
    """A generated set; "tiny", the packaged set of 16 pairs; or a folder of pair folders with a truth.npz each."""

    methods: Annotated[tuple[str, ...], option("METHOD...")]
    """NAME, NAME:OPTION=VALUE,OPTION=VALUE or LABEL=NAME:...; `objectflow methods` lists the names. oracle-masks and
    oracle-motion are given the truth and are marked in the tables."""

    split: str = "test"
    """Split of a generated set."""

    sequences: bool = False
    """Use frames 20 and 80 of the set's sequences (the paper's TestSeq); methods for sequences get all frames."""

    consecutive: bool = False
    """Use all pairs of consecutive frames of the set's sequences."""

    limit: Annotated[int | None, option("N", "all")] = None
    """Number of pairs, from the start of the set."""

    camera: Literal["auto", "static", "moving"] = "auto"
    """The camera option of all methods; METHOD:camera=... sets it for one method."""

    sensor: Annotated[str | None, option("NAME", "exact frames")] = None
    """Add the noise of a camera to a generated set: structured-light, time-of-flight, stereo,
    passive-stereo or noisy-stereo."""

    translation_only: Annotated[tuple[str, ...], option("NAME...", "none")] = ()
    """Names of real objects whose true rotation is too inaccurate for scoring."""

    out: Annotated[Path | None, option("DIR", "a folder under objectflow_out, named after the set")] = None
    """Output folder: new, empty, or that of an earlier evaluation."""

    workers: int = 1
    """Number of parallel estimates. Each takes longer if several run in parallel: measure runtimes with 1."""

    ray: Annotated[str | None, option("ADDRESS", "this machine")] = None
    """Address of a Ray cluster ("auto", "host:6379"), or "local"; --workers is then the number of actors."""

    report: bool = True
    """Write report.html."""

    def run(self) -> None:
        """Make missing predictions, score them, and print and write the tables."""
        specs = parse_methods(self.methods, camera=self.camera)
        pairs: PairSet = open_set(
            self.data, split=self.split, sequences=self._sequences(), translation_only=self.translation_only
        )
        if self.sensor is not None:
            from objectflow.evaluation.data.noisy import NoisyPairs

            pairs = NoisyPairs(pairs, self.sensor)
        keys = pairs.keys[: self._limit()]
        out = self.out or OUTPUT_ROOT / _folder_name(self.data, pairs)
        _check_folder(out)
        sweep(out)
        console = Console(stderr=True)
        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
        with Bar(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
            tasks = {spec.label: bar.add_task(spec.label, total=len(keys)) for spec in specs}

            def on_prediction(now: PredictionProgress) -> None:
                failed = f", {now.failed} failed" if now.failed else ""
                bar.update(tasks[now.label], completed=now.done, description=now.label + failed)

            predict(pairs, keys, specs, out, workers=self.workers, ray=self.ray, report=on_prediction)
            scoring = bar.add_task("scoring", total=len(keys))
            evaluation = score(pairs, keys, specs, out, report=lambda done: bar.update(scoring, completed=done))
        _check_scored(evaluation)
        tables = make_tables(evaluation)
        print_tables(tables, Console(highlight=False))
        _write(out, evaluation, tables)
        if self.report:
            from objectflow.view.report import write_report

            write_report(out / "report.html", evaluation, CachedPairs(pairs, specs, out))
        print(f"written to {out}")

    def _sequences(self) -> SequenceUse:
        if self.sequences and self.consecutive:
            raise DatasetError("--sequences and --consecutive exclude each other: give one of them")
        return "paper" if self.sequences else "consecutive" if self.consecutive else "none"

    def _limit(self) -> int | None:
        if self.limit is not None and self.limit < 1:
            raise DatasetError(f"--limit must be at least 1, not {self.limit}")
        return self.limit


def _folder_name(data: str, pairs: PairSet) -> str:
    words = ["evaluate", "real" if pairs.kind == "real" else "", pairs.data, "" if data == "tiny" else pairs.split]
    words.append(pairs.kind if pairs.kind in ("sequences", "consecutive") else "")
    return re.sub(r"[^\w.-]", "_", "-".join(filter(None, words)))


def _check_folder(out: Path) -> None:
    """Check that the output folder is new, empty, or that of an earlier evaluation."""
    check_not_below_a_file(out)
    if out.exists() and not out.is_dir():
        raise ResultError(f"{out} is a file, not a folder: name another output folder")
    if out.is_dir() and any(out.iterdir()) and not (out / FOLDER).is_dir():
        raise ResultError(f"{out} exists and is not an earlier evaluation: name another output folder")


def _check_scored(evaluation: Evaluation) -> None:
    """Raise an error if every method failed on every pair, since there are no tables then."""
    if not any(method.scores for method in evaluation.methods):
        first = evaluation.methods[0].failures[0]
        raise MethodError(
            f"every method failed on every pair; {evaluation.methods[0].label} on {first.key}: {first.reason}"
        )


def _write(out: Path, evaluation: Evaluation, tables: Tables) -> None:
    evaluation.write(out / "results.json")
    files.write_text(out / "tables.md", to_markdown(tables))
    files.write_text(out / "tables.csv", to_csv(tables))
    files.write_text(out / "tables.json", to_json(tables))
