"""A run that was stopped or killed and then resumed equals an uninterrupted one."""

from __future__ import annotations

import dataclasses
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from helpers.paths import HELPERS_ON_PATH
from helpers.training_runs import RECIPE, checkpoint_tensors, job, write_set
from objectflow.errors import TrainingError
from objectflow.storage import files
from objectflow.storage.files import remove_folder
from objectflow.training.callbacks import Callback
from objectflow.training.loop import train


class StopAt(Callback):
    """Sends this process a signal after a step."""

    def __init__(self, step: int, number: int) -> None:
        self.step, self.number = step, number

    def line(self, step: int, progress: float, line: Mapping[str, Any]) -> None:
        if step == self.step:
            os.kill(os.getpid(), self.number)


def losses_of(run: Path) -> list[tuple[str, int, dict[str, float]]]:
    lines = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    return [(line["kind"], line["step"], line["losses"]) for line in lines]


def assert_same(one: Path, other: Path) -> None:
    left, right = checkpoint_tensors(one), checkpoint_tensors(other)
    assert left.keys() == right.keys()
    assert [name for name in left if not torch.equal(left[name], right[name])] == []
    assert losses_of(one) == losses_of(other)


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_set(tmp_path_factory.mktemp("set"))


def test_a_run_in_two_parts_equals_a_whole_one(data: Path, tmp_path: Path) -> None:
    recipe = dataclasses.replace(RECIPE, steps=40, validate_every=12, log_every=7)
    whole = train(job(data, tmp_path / "whole", recipe))
    assert (whole.finished, whole.state.step, whole.signal) == (True, 40, 0)
    # The signal arrives after step 21 is logged, so the run ends after the next step.
    first = train(job(data, tmp_path / "parts", recipe), StopAt(21, signal.SIGTERM))
    assert (first.finished, first.state.step, first.signal) == (False, 22, signal.SIGTERM)
    second = train(job(data, tmp_path / "parts", recipe, resume=True))
    assert (second.finished, second.state.step) == (True, 40)
    left, right = checkpoint_tensors(tmp_path / "whole"), checkpoint_tensors(tmp_path / "parts")
    assert left.keys() == right.keys()
    assert [name for name in left if not torch.equal(left[name], right[name])] == []
    validations = [
        [line for line in losses_of(tmp_path / name) if line[0] == "validation"] for name in ("whole", "parts")
    ]
    assert validations[0] == validations[1]
    assert [step for _, step, _ in validations[0]] == [12, 24, 36, 40]
    # A finished run has nothing left to do.
    again = train(job(data, tmp_path / "parts", recipe, resume=True))
    assert (again.finished, again.state.step) == (True, 40)


def test_an_interrupt_ends_a_run_gracefully_too(data: Path, tmp_path: Path) -> None:
    before = signal.getsignal(signal.SIGINT)
    outcome = train(job(data, tmp_path / "run"), StopAt(5, signal.SIGINT))
    assert (outcome.finished, outcome.state.step, outcome.signal) == (False, 6, signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) == before


def test_killed_at_any_moment_and_resumed(data: Path, tmp_path: Path) -> None:
    out = tmp_path / "killed"
    script = [sys.executable, "-m", "helpers.training_runs", "killed", str(data), str(out)]
    process = subprocess.Popen(script, env={**os.environ, **HELPERS_ON_PATH, "OMP_NUM_THREADS": "1"})
    rng = np.random.default_rng(time.time_ns() % 2**32)  # a random moment
    lines, wait = int(rng.integers(1, 12)), float(rng.uniform(0, 0.05))
    metrics, deadline = out / "metrics.jsonl", time.monotonic() + 100
    while not metrics.exists() or len(metrics.read_text().splitlines()) < lines:
        assert process.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.002)
    time.sleep(wait)
    process.kill()
    process.wait()
    recipe = dataclasses.replace(RECIPE, checkpoint_minutes=0.0, log_every=2, steps=40)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        train(job(data, out, recipe, resume=True))
        train(job(data, tmp_path / "whole", recipe))
    finally:
        torch.set_num_threads(threads)
    assert_same(out, tmp_path / "whole")
    assert not [path for path in (out / "checkpoints").iterdir() if path.name.startswith(".")]


@pytest.mark.parametrize("validation_pairs", [0, 4])
def test_a_run_that_is_killed_after_its_last_checkpoint_is_complete(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, validation_pairs: int
) -> None:
    recipe = dataclasses.replace(
        RECIPE, steps=2, validation_pairs=validation_pairs, checkpoint_minutes=0.0, keep_checkpoints=1, log_every=1
    )
    train(job(data, tmp_path / "whole", recipe))
    root = tmp_path / "killed" / "checkpoints"

    def end_before_removal(path: Path) -> None:
        if len(list(root.iterdir())) == 2:  # both steps
            raise SystemExit
        remove_folder(path)

    with monkeypatch.context() as patch:
        patch.setattr(files, "remove_folder", end_before_removal)
        with pytest.raises(SystemExit):
            train(job(data, tmp_path / "killed", recipe))
    assert len(list(root.iterdir())) == 2
    assert train(job(data, tmp_path / "killed", recipe, resume=True)).finished
    names = [sorted(str(path.relative_to(out)) for path in out.rglob("*")) for out in sorted(tmp_path.iterdir())]
    assert names[0] == names[1]
    assert {"loss_curve.png", "weights.safetensors"} <= set(names[0])
    assert_same(tmp_path / "killed", tmp_path / "whole")


def test_a_torn_last_line_is_cut(data: Path, tmp_path: Path) -> None:
    recipe = dataclasses.replace(RECIPE, steps=20)
    train(job(data, tmp_path / "whole", recipe))
    train(job(data, tmp_path / "torn", recipe), StopAt(10, signal.SIGTERM))
    with open(tmp_path / "torn" / "metrics.jsonl", "a") as file:
        file.write('{"kind": "train", "step": 12, "lo')
    train(job(data, tmp_path / "torn", recipe, resume=True))
    steps = [step for kind, step, _ in losses_of(tmp_path / "torn") if kind == "train"]
    assert steps == [5, 10, 11, 15, 20]


def test_only_the_last_checkpoints_stay(data: Path, tmp_path: Path) -> None:
    recipe = dataclasses.replace(RECIPE, checkpoint_minutes=0.0, keep_checkpoints=3)
    train(job(data, tmp_path / "run", recipe))
    names = sorted(path.name for path in (tmp_path / "run" / "checkpoints").iterdir())
    assert names == ["step-00000020", "step-00000025", "step-00000030"]


def test_another_run_is_never_written_over(data: Path, tmp_path: Path) -> None:
    recipe, out = dataclasses.replace(RECIPE, steps=5), tmp_path / "run"
    train(job(data, out, recipe))
    before = {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}
    with pytest.raises(TrainingError, match=r"holds this run already \(step-00000005\): add --resume"):
        train(job(data, out, recipe))
    with pytest.raises(TrainingError, match=r"with recipe.learning_rate = 0.001, now it is 0.002"):
        train(job(data, out, dataclasses.replace(recipe, learning_rate=2e-3), resume=True))
    model = dataclasses.replace(recipe.model, network=dataclasses.replace(recipe.model.network, reach=3))
    with pytest.raises(TrainingError, match=r"with recipe.model.network.reach = 2, now it is 3"):
        train(job(data, out, dataclasses.replace(recipe, model=model), resume=True))
    with pytest.raises(TrainingError, match=r"with data.train = "):
        train(job(write_set(tmp_path / "other", pairs=9), out, recipe, resume=True))
    assert before == {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}
    # Fields that do not affect the weights may change.
    train(job(data, out, dataclasses.replace(recipe, keep_checkpoints=5), resume=True))
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "thesis.txt").write_text("years of work")
    with pytest.raises(TrainingError, match="exists and holds no run"):
        train(job(data, tmp_path / "full", recipe, resume=True))
