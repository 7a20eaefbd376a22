"""`objectflow evaluate`: methods on a set with truth: tables, and a report to look at."""

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

EXAMPLES = """\
  objectflow evaluate --data tiny --methods zero dense-flow consensus oracle-masks oracle-motion
  objectflow evaluate --data data --split test --limit 200 --methods zero consensus --out table
  objectflow evaluate --data data --sequences --methods consensus
  objectflow evaluate --data data --sensor structured-light --methods consensus
  objectflow evaluate --data real:recordings --methods zero dense-flow consensus --translation-only ball
  objectflow evaluate --data tiny --methods consensus quick=consensus:rounds=1,match_width=320
"""


@dataclass(frozen=True)
class Evaluate:
    """Run methods on pairs with truth and print the paper's two tables with their rows beside the paper's own.

    Predictions are cached in predictions/<method>/<pair>.npz and scored from there: the same command continues a run
    that was cut off, and further methods or pairs may be added to it. Writes tables.md, tables.csv, tables.json,
    results.json and report.html.
    """

    data: Annotated[str, option("DIR|tiny|real:DIR")]
    """A generated set; the set of 16 pairs that comes with the package; or pair folders with a truth.npz each."""

    methods: Annotated[tuple[str, ...], option("METHOD...")]
    """NAME, NAME:OPTION=VALUE,OPTION=VALUE or LABEL=NAME:...; `objectflow methods` lists the names. oracle-masks and
    oracle-motion see the truth and are marked."""

    split: str = "test"
    """Of a generated set."""

    sequences: bool = False
    """Take frames 20 and 80 of the set's sequences (the paper's TestSeq); methods that want all frames get them."""

    consecutive: bool = False
    """Take every two frames that follow each other in the set's sequences."""

    limit: Annotated[int | None, option("N", "all")] = None
    """Only the first pairs."""

    camera: Literal["auto", "static", "moving"] = "auto"
    """What methods are told of the camera; METHOD:camera=... says it to one."""

    sensor: Annotated[str | None, option("NAME", "exact frames")] = None
    """Show a generated set as a depth camera has it: structured-light, time-of-flight, stereo or passive-stereo."""

    translation_only: Annotated[tuple[str, ...], option("NAME...", "none")] = ()
    """Real objects whose true rotation is not known well enough to be scored."""

    out: Annotated[Path | None, option("DIR", "a folder under objectflow_out, named after the set")] = None
    """Output folder: new, empty, or an earlier evaluation's."""

    workers: int = 1
    """Estimates at a time. Those that run side by side take longer each: time methods with 1."""

    ray: Annotated[str | None, option("ADDRESS", "this machine")] = None
    """Address of a Ray cluster ("auto", "host:6379"), or "local"; --workers is then the number of actors."""

    report: bool = True
    """Write report.html."""

    def run(self) -> None:
        """Predict what is missing, score, print, write."""
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
            raise DatasetError("--sequences and --consecutive are two ways to take pairs: give one of them")
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
    """Only a folder of an earlier evaluation may be written into."""
    check_not_below_a_file(out)
    if out.exists() and not out.is_dir():
        raise ResultError(f"{out} is a file, not a folder: name another output folder")
    if out.is_dir() and any(out.iterdir()) and not (out / FOLDER).is_dir():
        raise ResultError(f"{out} exists and is no earlier evaluation: name another output folder")


def _check_scored(evaluation: Evaluation) -> None:
    """A set on which everything failed has no tables."""
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
