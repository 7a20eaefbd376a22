"""`generate`, `check` and `show` on small generated sets."""

from __future__ import annotations

import json
import shutil
import time
from pathlib import Path

import numpy as np
import pytest

import interruptions
from objectflow.cli import main
from objectflow.dataset.shards import open_pairs, open_sequences
from objectflow.synth.generation import jobs as generation_jobs

pytest.importorskip("mujoco_warp", reason="generating needs the extra [synth]")


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("data") / "set"
    words = ["generate", "--out", str(folder), "--preset", "small", "--pairs", "3", "--workers", "1", "--split", "val"]
    assert main(words) == 0
    return folder


def test_pairs_warp_onto_each_other(data: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", str(data), "--json"]) == 0
    (report,) = json.loads(capsys.readouterr().out)
    assert report["rows"] == 3
    assert report["wrong"] == []
    assert report["depth_mm"]["count"] > 100
    assert report["depth_mm"]["median"] < 1


def test_two_workers_produce_the_same_bytes(data: Path, tmp_path: Path) -> None:
    words = ["generate", "--preset", "small", "--pairs", "3", "--workers", "2", "--split", "val"]
    assert main([*words, "--out", str(tmp_path / "two")]) == 0
    for path in sorted(data.iterdir()):
        assert (tmp_path / "two" / path.name).read_bytes() == path.read_bytes()


def test_a_killed_and_resumed_run_produces_the_same_bytes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Killed after its first shard; `python benchmarks/interruptions.py` kills at ten moments, also with Ray."""
    settings = interruptions.Settings(pairs=6, rows_a_shard=2)
    monkeypatch.setattr(generation_jobs, "ROWS_A_SHARD", settings.rows_a_shard)
    words = ["generate", "--preset", "small", "--samples", "1", "--pairs", "6", "--workers", "1"]
    assert main([*words, "--out", str(tmp_path / "one")]) == 0
    manifest = tmp_path / "killed" / "manifest.json"
    for _ in range(5):  # On a busy machine, a run may end before it is killed.
        shutil.rmtree(tmp_path / "killed", ignore_errors=True)
        process = interruptions.start(settings, tmp_path / "killed", "--workers", "2")
        deadline = time.monotonic() + 300
        while not list((tmp_path / "killed").glob("*.parquet")) and process.poll() is None:
            assert time.monotonic() < deadline
            time.sleep(0.01)
        if interruptions.kill(process, after=0.0) and not manifest.exists():
            break
    assert list((tmp_path / "killed").glob("*.parquet"))
    assert not manifest.exists()
    interruptions.finish(settings, tmp_path / "killed", "--workers", "2")
    assert interruptions.content(tmp_path / "killed") == interruptions.content(tmp_path / "one")


def test_views_share_their_scene_and_sequences_have_eight_frames(tmp_path: Path) -> None:
    words = ["generate", "--preset", "small", "--workers", "1", "--split", "test", "--out", str(tmp_path / "set")]
    assert main([*words, "--pairs", "2", "--views", "2", "--sequences", "1"]) == 0
    first, second = open_pairs(tmp_path / "set", "test")
    assert first.scene == second.scene
    assert first.key != second.key
    assert not np.array_equal(first.curr.color, second.curr.color)
    rows = list(open_sequences(tmp_path / "set", "test"))
    assert [row.frame for row in rows] == [20, 30, 40, 50, 60, 70, 80, 90]
    # Scene 0 of the pairs and scene 0 of the sequences are different scenes with different names.
    assert {row.sequence for row in rows} == {"test-sequence-000000"}
    assert first.scene == "test-000000"


def test_show_draws_a_row_and_reports_unknown_keys(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    picture = tmp_path / "row.png"
    assert main(["show", str(data), "--key", "val-000001", "--out", str(picture)]) == 0
    assert picture.stat().st_size > 10_000
    capsys.readouterr()
    assert main(["show", str(data), "--key", "val-000099", "--out", str(tmp_path / "none.png")]) == 2
    assert "val-000099" in capsys.readouterr().err
    assert not (tmp_path / "none.png").exists()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--pairs", "1", "--split", "dev"], "unknown split 'dev': choose one of train, val, test"),
        (["--pairs", "1", "--preset", "huge"], "unknown preset 'huge': choose one of paper, small"),
        ([], "nothing to generate"),
        (["--pairs", "1", "--shard", "5/2"], "1 <= i <= n"),
        (["--pairs", "1", "--shard", "one"], "must be i/n"),
        (["--pairs", "1", "--mesh-folder", "."], "mesh"),
    ],
)
def test_errors_are_one_line_and_leave_no_files(
    words: list[str], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["generate", "--out", str(tmp_path / "set"), "--workers", "1", *words]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_another_seed_is_refused_and_the_set_is_unchanged(data: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = {path.name: path.read_bytes() for path in data.iterdir()}
    words = ["generate", "--out", str(data), "--preset", "small", "--pairs", "3", "--workers", "1", "--split", "val"]
    assert main([*words, "--seed", "7"]) == 2
    assert "holds shards of seed 0, not 7" in capsys.readouterr().err
    assert {path.name: path.read_bytes() for path in data.iterdir()} == before
