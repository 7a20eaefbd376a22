"""Train the paper's three networks alike, evaluate them beside the baselines, and print what the paper claims.

    python scripts/paper_networks.py OUT --data data --hours 4

DATA is a set with the splits train, val and test, the last with sequences. OUT/s-1, OUT/c-1 and OUT/c-vl-1 are runs of
`objectflow train` of equal length, OUT/test and OUT/sequences are evaluations, and OUT/curves-1.png shows the loss of
s and c (the paper's figure 5). With --options of several stages, OUT/s-2 continues from the weights of OUT/s-1, and so
on:

    python scripts/paper_networks.py OUT --data data --hours 4 --options "--learning-rate 2e-3" \
        "--learning-rate 1e-3 --size 192 256 --batch-size 6"

The same command continues what was interrupted.
"""

from __future__ import annotations

import dataclasses
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import tyro
from tyro.conf import Positional

from objectflow.evaluation.metrics.pair_score import PairScore
from objectflow.evaluation.results import Evaluation
from objectflow.evaluation.tables.bootstrap import Bootstrap

ROOT = Path(__file__).resolve().parents[1]
PROGRAM = (sys.executable, "-m", "objectflow")
VARIANTS = ("s", "c", "c-vl")
CLASSICAL = ("zero", "vo-sf", "pd-flow", "sr-flow")
"""The paper's baselines of scene flow, and zero flow; the first tables of the paper have no other."""
PAPER_RATIO = 4.290 / 6.431
"""Masked end-point error of OurC+vL+Rig over that of VO-SF, the paper's best baseline."""


@dataclasses.dataclass(frozen=True)
class Settings:
    """Trains and evaluates the paper's networks."""

    out: Positional[Path]
    """Folder of runs, evaluations and pictures."""
    data: Path
    """Set with the splits train, val and test."""
    extra_data: tuple[Path, ...] = ()
    """More sets, whose split train is mixed in."""
    hours: float = 4.0
    """Time of each training, which its stages share evenly."""
    recipe: str = "cpu"
    """Recipe of `objectflow train`: paper, gpu or cpu."""
    options: tuple[str, ...] = ("",)
    """More options of `objectflow train`, for all three alike: one text for each stage, as --options "..." "..."."""
    correlation_options: str = ""
    """More options of c and c-vl in every stage, such as those of XFeat, which s has no use for."""
    pairs: int = 1000
    """Number of test pairs."""
    baseline_pairs: int = 100
    """Number of test pairs on which the baselines of scene flow, which are slow, are evaluated."""


def call(*words: str) -> None:
    """Run a command of objectflow."""
    print(f"$ objectflow {shlex.join(words)}", flush=True)
    subprocess.run([*PROGRAM, *words], check=True)


def stage(out: Path, variant: str, number: int) -> Path:
    """The run of one stage of a network's training; stages count from 1."""
    return out / f"{variant}-{number}"


def train(settings: Settings) -> None:
    """Train the networks one after another, each for the same time."""
    out, stages = settings.out, len(settings.options)
    extra = ["--extra-data", *map(str, settings.extra_data)] if settings.extra_data else []
    for variant in VARIANTS:
        for number, options in enumerate(settings.options, 1):
            words = ["--recipe", settings.recipe, "--variant", variant, "--data", str(settings.data), *extra]
            words += ["--out", str(stage(out, variant, number)), "--resume"]
            words += ["--minutes", f"{60 * settings.hours / stages:g}"]
            if number > 1:
                words += ["--start-from", str(stage(out, variant, number - 1) / "weights.safetensors")]
            own = "" if variant == "s" else settings.correlation_options
            call("train", *words, *shlex.split(options), *shlex.split(own))
    for number in range(1, stages + 1):
        runs = [str(stage(out, variant, number)) for variant in VARIANTS[:2]]
        picture = str(out / f"curves-{number}.png")
        subprocess.run([sys.executable, str(ROOT / "scripts" / "compare_runs.py"), picture, *runs], check=True)


def networks(settings: Settings) -> list[str]:
    """The networks with every form of rigid motion, as methods of `objectflow evaluate`."""
    runs = {variant: stage(settings.out, variant, len(settings.options)) for variant in VARIANTS}
    return [
        f"{variant}+{rigid}=sceneflownet-{variant}:weights={runs[variant] / 'weights.safetensors'},rigid={rigid}"
        for variant in VARIANTS
        for rigid in ("none", "average", "refine")
    ]


def evaluate(settings: Settings) -> None:
    """Evaluate all methods on pairs, and those that are fast enough on more pairs and on sequences."""
    out, common = settings.out, ["--data", str(settings.data), "--split", "test", "--camera", "static"]
    fast = ["zero", "consensus", "rigidmatch", *networks(settings)]
    slow = [*CLASSICAL, *networks(settings)]
    call(
        "evaluate",
        *common,
        "--limit",
        str(settings.baseline_pairs),
        "--out",
        str(out / "baselines"),
        "--methods",
        *slow,
    )
    call("evaluate", *common, "--limit", str(settings.pairs), "--out", str(out / "test"), "--methods", *fast)
    call("evaluate", *common, "--sequences", "--out", str(out / "sequences"), "--methods", "homc", *fast)


def error(score: PairScore) -> float:
    """Masked end-point error, cm."""
    return score.flow.masked.epe_cm


def f_measure(score: PairScore) -> float:
    """Mean F of the segmentation."""
    return score.segmentation.mean_f.f


def difference(evaluation: Evaluation, label: str, other: str, of: str) -> str:
    """Mean difference of two methods over the pairs that both have a score for, with its interval."""
    measure = {"error": error, "f": f_measure}[of]
    first, second = ({score.key: score for score in evaluation.method(name).scores} for name in (label, other))
    keys = [pair.key for pair in evaluation.pairs if pair.key in first and pair.key in second]
    bootstrap = Bootstrap([first[key].scene for key in keys], np.random.default_rng(0))
    found = bootstrap.mean([measure(first[key]) - measure(second[key]) for key in keys])
    digits = 2 if of == "error" else 3
    return f"{found.value:+.{digits}f} [{found.low:+.{digits}f}, {found.high:+.{digits}f}]"


def mean_error(evaluation: Evaluation, label: str) -> float:
    """Masked end-point error of a method, cm."""
    return float(np.nanmean([error(score) for score in evaluation.method(label).scores]))


def claims(test: Evaluation, baselines: Evaluation) -> list[str]:
    """The paper's claims as measured here, one line each."""
    zero, best = mean_error(test, "zero"), min(CLASSICAL, key=lambda label: mean_error(baselines, label))
    lines = [
        f"masked EPE relative to zero flow, {label}: {mean_error(test, label) / zero:.2f}"
        for label in ("s+average", "c+average", "c-vl+none", "c-vl+average", "c-vl+refine")
    ]
    ratio = mean_error(baselines, "c-vl+refine") / mean_error(baselines, best)
    lines.append(f"masked EPE relative to the best baseline ({best}): {ratio:.2f}; in the paper {PAPER_RATIO:.2f}")
    for words, label, other, of in (
        ("effect of the correlation on masked EPE, cm", "c+average", "s+average", "error"),
        ("effect of the correlation on F", "c+average", "s+average", "f"),
        ("effect of vL on masked EPE, cm", "c-vl+average", "c+average", "error"),
        ("effect of vL on F", "c-vl+average", "c+average", "f"),
        ("effect of one motion per object on masked EPE, cm", "c-vl+average", "c-vl+none", "error"),
        ("effect of registration on masked EPE, cm", "c-vl+refine", "c-vl+average", "error"),
    ):
        lines.append(f"{words}: {difference(test, label, other, of)}")
    return lines


def main(settings: Settings) -> None:
    """Train, evaluate, and print the claims."""
    settings.out.mkdir(parents=True, exist_ok=True)
    train(settings)
    evaluate(settings)
    test, baselines = (Evaluation.read(settings.out / name / "results.json") for name in ("test", "baselines"))
    print("\n".join(claims(test, baselines)))


if __name__ == "__main__":
    main(tyro.cli(Settings))
