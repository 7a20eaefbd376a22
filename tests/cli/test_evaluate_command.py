"""`evaluate` on the packaged set and on pair folders: files, repeated runs and one-line errors."""

from __future__ import annotations

import csv
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from importlib import resources
from pathlib import Path

import numpy as np
import pytest

from helpers import small_sets
from helpers.pair_sets import write_part
from objectflow.cli import main
from objectflow.evaluation.results import Evaluation

DEMO = Path(str(resources.files("objectflow"))) / "demo" / "pair"


def evaluate(*words: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "objectflow", "evaluate", *words]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def make_real(folder: Path, *names: str) -> Path:
    """Pair folders with the demo's frames and a made-up truth: an object at the image centre moved by 1 cm."""
    for name in names:
        shutil.copytree(DEMO, folder / name)
        size = json.loads((DEMO / "camera.json").read_text())
        labels = np.zeros((size["height"], size["width"]), np.uint8)
        labels[200:280, 300:380] = 1
        motion = np.eye(4)
        motion[0, 3] = 0.01
        np.savez(folder / name / "truth.npz", labels1=labels, prev_T_curr=motion[None], names=np.array(["thing"]))
    return folder


def test_the_packaged_set_from_a_shell(tmp_path: Path) -> None:
    out = tmp_path / "out"
    words = ("--data", "tiny", "--methods", "zero", "oracle-motion", "--out", str(out))
    first = evaluate(*words)
    assert (first.returncode, first.stderr) == (0, "")
    assert "oracle-motion †" in first.stdout
    assert "OurC+vL+Rig (paper)" in first.stdout
    assert "16 of 16 pairs (16 scenes) of tiny" in first.stdout
    assert sorted(path.name for path in out.iterdir()) == [
        "predictions", "report.html", "results.json", "tables.csv", "tables.json", "tables.md",
    ]  # fmt: skip
    assert "oracle-motion" in (out / "report.html").read_text(encoding="utf-8")
    evaluation = Evaluation.read(out / "results.json")
    zero, oracle = evaluation.methods
    assert zero.summary is not None
    assert oracle.summary is not None
    assert zero.summary.flow_masked.epe_cm.value > 5
    assert oracle.summary.flow_masked.epe_cm.value < 0.1
    with open(out / "tables.csv", newline="") as file:
        assert {line["row"] for line in csv.DictReader(file)} >= {"zero", "oracle-motion", "PD-Flow", "HOMC"}
    # A second run reuses the predictions and writes the same files.
    before = small_sets.digest(out)
    assert main(["evaluate", *words]) == 0
    assert small_sets.digest(out) == before


def test_a_killed_run_is_resumed(tmp_path: Path) -> None:
    out = tmp_path / "out"
    words = ("--data", "tiny", "--methods", "dense-flow", "--out", str(out), "--no-report")
    command = [sys.executable, "-m", "objectflow", "evaluate", *words]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    deadline = time.monotonic() + 60
    while len(list(out.rglob("*.npz"))) < 3 and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    process.wait()
    made = {path: path.read_bytes() for path in out.rglob("*.npz")}
    assert 3 <= len(made) <= 16
    assert main(["evaluate", *words]) == 0
    assert len(list(out.rglob("*.npz"))) == 16
    assert list(out.rglob("*.tmp")) == []
    assert all(path.read_bytes() == data for path, data in made.items())


def test_no_extra_is_required(tmp_path: Path) -> None:
    extras = ("mujoco", "mujoco_warp", "trimesh", "coacd", "ray", "pybullet", "datasets", "onnx")
    program = (
        f"import sys; sys.modules.update(dict.fromkeys({extras!r}))\n"
        "from objectflow.cli import main; sys.exit(main(sys.argv[1:]))"
    )
    words = ["evaluate", "--data", "tiny", "--limit", "1", "--methods", "zero", "--no-report"]
    command = [sys.executable, "-c", program, *words, "--out", str(tmp_path / "out")]
    found = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (found.returncode, found.stderr) == (0, "")


def test_pair_folders(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    make_real(tmp_path / "real", "a", "b")
    words = ["evaluate", "--data", "real:real", "--methods", "zero", "none=zero", "--no-report"]
    assert main([*words, "--translation-only", "thing", "--limit", "1"]) == 0
    assert "written to objectflow_out/evaluate-real-real" in capsys.readouterr().out
    evaluation = Evaluation.read(Path("objectflow_out/evaluate-real-real/results.json"))
    assert ([pair.key for pair in evaluation.pairs], evaluation.total) == (["a"], 2)
    assert [method.label for method in evaluation.methods] == ["zero", "none"]
    summary = evaluation.methods[0].summary
    assert summary is not None
    assert summary.flow_masked.epe_cm.value == pytest.approx(1, abs=1e-4)  # The error of `zero` is the true motion.
    assert np.isnan(evaluation.pairs[0].objects[0].rotation_deg)


def test_sequences(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    small_sets.write_sequences(tmp_path / "set")
    assert main(["evaluate", "--data", "set", "--methods", "zero", "--sequences", "--no-report"]) == 0
    assert "those of TestSeq" in capsys.readouterr().out
    assert main(["evaluate", "--data", "set", "--methods", "zero", "--consecutive", "--no-report"]) == 0
    assert "14 of 14 pairs (2 scenes)" in capsys.readouterr().out
    assert sorted(os.listdir("objectflow_out")) == ["evaluate-set-test-consecutive", "evaluate-set-test-sequences"]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--data", "nowhere"], "nowhere: no such folder"),
        (["--data", "set", "--split", "val"], "no pairs of split 'val'"),
        (["--data", "set", "--sequences"], "no sequences of split 'test'"),
        (["--data", "set", "--sequences", "--consecutive"], "give one of them"),
        (["--data", "empty"], "split 'test' has no pairs"),
        (["--data", "real:set"], "no pair folders in it"),
        (["--data", "real:."], "none of its pairs has a truth.npz"),
        (["--data", "set", "--limit", "0"], "--limit must be at least 1"),
        (["--data", "set", "--workers", "0"], "--workers must be at least 1"),
        (["--data", "set", "--methods", "magic"], "unknown method 'magic'"),
        (["--data", "set", "--methods", "zero", "zero"], "two methods are called 'zero'"),
        (["--data", "set", "--out", "file"], "file is a file, not a folder"),
        (["--data", "set", "--out", "file/below"], "is a file, not a folder"),
        (["--data", "set", "--out", "set"], "is not an earlier evaluation"),
        (["--data", "set", "--out", "done"], "predictions of another data set"),
        (["--data", "set", "--out", "done", "--camera", "static"], "predictions of another data set"),
        (["--data", "other", "--out", "done", "--methods", "zero=dense-flow"], 'made with method = "zero"'),
        (["--data", "set", "--camera", "flying"], "camera"),
        ([], "data"),
    ],
)
def test_errors_are_one_line(
    words: list[str], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    small_sets.write_box_pairs(tmp_path / "set", 2)
    small_sets.write_box_pairs(tmp_path / "other", 2, seed=5)
    write_part(tmp_path / "empty", "pairs", [], "test")
    shutil.copytree(DEMO, tmp_path / "pair", ignore=shutil.ignore_patterns("truth.npz"))
    (tmp_path / "file").touch()
    assert main(["evaluate", "--data", "other", "--methods", "zero", "--out", "done", "--no-report"]) == 0
    capsys.readouterr()
    before = small_sets.digest(tmp_path)
    methods = [] if "--methods" in words else ["--methods", "zero"]
    assert main(["evaluate", *words, *methods, "--no-report"]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert "internal error" not in error
    assert small_sets.digest(tmp_path) == before


@pytest.mark.skipif(os.geteuid() == 0, reason="root can write anywhere")
def test_a_read_only_folder_is_reported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    small_sets.write_box_pairs(tmp_path / "set", 1)
    (tmp_path / "closed").mkdir(mode=0o555)
    words = ["evaluate", "--data", str(tmp_path / "set"), "--methods", "zero", "--no-report"]
    assert main([*words, "--out", str(tmp_path / "closed" / "out")]) == 1
    assert capsys.readouterr().err.count("\n") == 1


def test_a_write_error_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    small_sets.write_box_pairs(tmp_path / "set", 1)
    words = ["evaluate", "--data", str(tmp_path / "set"), "--methods", "zero", "--no-report"]
    assert main([*words, "--out", "/proc/evaluation"]) == 1
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "cannot write" in error


def test_an_evaluation_without_any_result_fails(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from objectflow.methods.baselines.zero import Zero

    def fail(*_: object) -> None:
        raise RuntimeError("broken")

    monkeypatch.setattr(Zero, "__call__", fail)
    small_sets.write_box_pairs(tmp_path / "set", 2)
    words = ["evaluate", "--data", str(tmp_path / "set"), "--methods", "zero", "--no-report"]
    assert main([*words, "--out", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err
    assert "every method failed on every pair; zero on test-000000: RuntimeError: broken" in error
