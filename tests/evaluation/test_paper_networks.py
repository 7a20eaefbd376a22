"""The script that trains the paper's networks: its differences and its claims, against plain means."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from helpers.report_set import estimate_noisy, estimate_zero, make_set
from paper_networks import CLASSICAL, PAPER_RATIO, Settings, claims, difference, mean_error, networks, train

NETWORKS = ("s+average", "c+average", "c-vl+none", "c-vl+average", "c-vl+refine")


def test_differences_are_of_the_pairs_that_both_methods_have() -> None:
    evaluation, _ = make_set(4, methods={"a": estimate_noisy, "b": estimate_zero}, fail=("a", "analytic-0002"))
    a, b = evaluation.method("a").scores, evaluation.method("b").scores
    kept = [score for score in b if score.key != "analytic-0002"]
    errors = [one.flow.masked.epe_cm - other.flow.masked.epe_cm for one, other in zip(a, kept, strict=True)]
    value, low, high = map(float, re.findall(r"[-+][0-9.]+", difference(evaluation, "a", "b", "error")))
    assert abs(value - np.mean(errors)) < 0.006
    assert min(errors) - 0.006 <= low <= value <= high <= max(errors) + 0.006
    assert low < high < 0
    parts = [one.segmentation.mean_f.f - other.segmentation.mean_f.f for one, other in zip(a, kept, strict=True)]
    assert abs(float(difference(evaluation, "a", "b", "f").split()[0]) - np.mean(parts)) < 0.0006


def test_claims_name_the_best_baseline_and_every_effect() -> None:
    methods = dict.fromkeys((*CLASSICAL, *NETWORKS), estimate_zero) | {"c-vl+refine": estimate_noisy}
    methods["pd-flow"] = estimate_noisy
    evaluation, _ = make_set(2, methods=methods)
    lines = claims(evaluation, evaluation)
    ratio = mean_error(evaluation, "c-vl+refine") / mean_error(evaluation, "zero")
    assert f"masked EPE relative to zero flow, c-vl+refine: {ratio:.2f}" in lines
    assert "masked EPE relative to zero flow, c-vl+average: 1.00" in lines
    assert f"masked EPE relative to the best baseline (pd-flow): 1.00; in the paper {PAPER_RATIO:.2f}" in lines
    assert round(PAPER_RATIO, 2) == 0.67
    assert "effect of vL on F: +0.000 [+0.000, +0.000]" in lines


def test_every_network_is_evaluated_with_every_form_of_rigid_motion() -> None:
    words = networks(Settings(Path("out"), Path("data"), options=("", "--size 192 256")))
    assert len(words) == 9
    assert words[1] == "s+average=sceneflownet-s:weights=out/s-2/weights.safetensors,rigid=average"


def test_stages_share_the_time_and_continue_each_other(monkeypatch: pytest.MonkeyPatch) -> None:
    called: list[list[str]] = []

    def record(command: list[str], check: bool) -> None:
        assert check
        called.append(command)

    monkeypatch.setattr("paper_networks.subprocess.run", record)
    stages = ("--learning-rate 2e-3", "--learning-rate 1e-3 --size 192 256")
    train(Settings(Path("out"), Path("data"), hours=3, options=stages, correlation_options="--model.network.xfeat"))
    runs = [command for command in called if "train" in command]
    assert [run[run.index("--out") + 1] for run in runs] == [
        f"out/{variant}-{number}" for variant in ("s", "c", "c-vl") for number in (1, 2)
    ]
    assert all("--start-from" not in run for run in runs[::2])
    assert {run[run.index("--minutes") + 1] for run in runs} == {"90"}
    assert [("--model.network.xfeat" in run) for run in runs] == [False, False, True, True, True, True]
    assert runs[3][runs[3].index("--start-from") + 1] == "out/c-1/weights.safetensors"
    assert runs[3][-4:] == ["--size", "192", "256", "--model.network.xfeat"]
    pictures = [command for command in called if "train" not in command]
    assert [command[-3:] for command in pictures] == [
        [f"out/curves-{number}.png", f"out/s-{number}", f"out/c-{number}"] for number in (1, 2)
    ]
