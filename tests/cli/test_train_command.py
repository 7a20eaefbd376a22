"""`objectflow train`: training, interruption, resumption and one-line errors."""

from __future__ import annotations

import dataclasses
import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch

from helpers.pair_sets import random_pair, without_objects, write_pairs
from helpers.training_runs import NETWORK, write_set
from objectflow import cli
from objectflow.dataset.manifest import Manifest
from objectflow.networks import SceneFlowNet
from objectflow.networks.weights import save_weights

TINY = [
    "--size", "24", "32", "--batch-size", "4", "--steps", "4", "--validate-every", "2", "--validation-pairs", "4",
    "--model.network.trunk-width", "8", "--model.network.trunk-blocks", "1", "1",
    "--model.network.color-channels", "8", "--model.network.reach", "2", "--device", "cpu",
]  # fmt: skip


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_set(tmp_path_factory.mktemp("set"))


def error_line(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    """The error of a refused command, which must be one line."""
    capsys.readouterr()
    code = cli.main(["train", *words])
    error = capsys.readouterr().err
    assert code == 2, error
    assert error.count("\n") == 1
    return error.removeprefix("objectflow: ")


def test_training_prints_the_path_of_the_weights(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "runs" / "tiny"
    assert cli.main(["train", "--data", str(data), "--out", str(out), *TINY]) == 0
    printed = capsys.readouterr().out
    assert "step 2: 4 validation pairs: loss " in printed
    assert printed.splitlines()[-1].startswith("4 steps, ")
    assert printed.splitlines()[-1].endswith(f"weights: {out / 'weights.safetensors'}")
    settings = json.loads((out / "settings.json").read_text())
    assert (settings["recipe_name"], settings["recipe"]["size"]) == ("cpu", [24, 32])
    assert sorted(path.name for path in out.iterdir() if path.is_file()) == [
        "loss_curve.png", "metrics.jsonl", "settings.json", "weights.safetensors",
    ]  # fmt: skip
    assert "add --resume" in error_line(capsys, "--data", str(data), "--out", str(out), *TINY)
    assert cli.main(["train", "--data", str(data), "--out", str(out), *TINY, "--resume"]) == 0


def test_a_run_stopped_by_a_signal_prints_how_to_resume(data: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    words = ["train", "--data", str(data), "--out", str(out), *TINY, "--steps", "100000", "--log-every", "1"]
    process = subprocess.Popen(
        [sys.executable, "-m", "objectflow", *words], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
    )  # fmt: skip
    deadline = time.monotonic() + 100
    while not (out / "metrics.jsonl").exists():
        assert process.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.02)
    process.send_signal(signal.SIGTERM)
    printed, errors = process.communicate(timeout=60)
    assert (process.returncode, errors) == (128 + signal.SIGTERM, "")
    last = printed.splitlines()[-1]
    assert last.startswith("stopped after step ")
    assert last.endswith(f"continue with: objectflow {' '.join(words)} --resume")
    step = int(last.removeprefix("stopped after step ").split(";")[0])
    assert [path.name for path in (out / "checkpoints").iterdir()] == [f"step-{step:08d}"]


def test_help_shows_the_defaults_of_the_recipe(capsys: pytest.CaptureFixture[str]) -> None:
    for name, number in (("paper", "0.0001"), ("cpu", "0.001")):
        assert cli.main(["train", "--recipe", name, "--help"]) == 0
        printed = capsys.readouterr().out
        assert printed.startswith("Examples:\n  objectflow train --recipe")
        assert re.search(rf"learning-rate[^-]*\(default:[\s│]+{number}\)", printed)


def test_unusable_data_is_refused(data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def refused(folder: Path) -> str:
        return error_line(capsys, "--data", str(folder), "--out", str(tmp_path / "run"), *TINY)

    assert "no such folder" in refused(tmp_path / "missing")
    (tmp_path / "empty").mkdir()
    assert "no manifest.json: not a data set" in refused(tmp_path / "empty")
    wrong = write_set(tmp_path / "wrong")
    shard = next(wrong.glob("*.parquet"))
    bytes_ = bytearray(shard.read_bytes())
    bytes_[len(bytes_) // 2] ^= 1
    shard.write_bytes(bytes_)
    assert f"{shard}: its hash differs from that in manifest.json" in refused(wrong)
    write_pairs(tmp_path / "nothing", [without_objects(random_pair(0, objects=1))])
    assert "split 'train': no object in any row" in refused(tmp_path / "nothing")
    only = write_set(tmp_path / "only")
    manifest = Manifest.read(only)
    dataclasses.replace(manifest, parts={"val": manifest.parts["val"]}).write(only)
    assert "no pairs of split 'train'; there is: val" in refused(only)
    assert not (tmp_path / "run").exists()


def test_invalid_options_are_refused(data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def refused(*words: str) -> str:
        return error_line(capsys, "--data", str(data), "--out", str(tmp_path / "run"), *TINY, *words)

    other = tmp_path / "other.safetensors"
    save_weights(other, SceneFlowNet(dataclasses.replace(NETWORK, reach=3)), {})
    assert "weights of another configuration: " in refused("--start-from", str(other))
    assert "no such file" in refused("--start-from", str(tmp_path / "missing.safetensors"))
    backbone = tmp_path / "resnet.pth"
    torch.save({"conv1.weight": torch.zeros(64, 3, 7, 7)}, backbone)
    sizes = "conv1.weight is (64, 3, 7, 7), but this trunk has (8, 3, 7, 7)"
    assert sizes in refused("--backbone-weights", str(backbone))
    assert "the simple network has no colour trunk" in refused("--backbone-weights", str(backbone), "--variant", "s")
    if not torch.cuda.is_available():
        assert "no CUDA device" in refused("--device", "cuda")
    assert "unknown recipe 'tpu': choose one of paper, gpu, cpu" in refused("--recipe", "tpu")
    assert "recipe field batch_size must be at least 1" in refused("--batch-size", "0")
    assert "trunk_blocks" in refused("--model.network.trunk-blocks", "0", "1")
    (tmp_path / "file").write_text("")
    assert "is a file" in refused("--out", str(tmp_path / "file"))
    assert not (tmp_path / "run").exists()
