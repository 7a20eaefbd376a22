"""`objectflow run --report`: the page of a run on a turning box, and of a run without objects."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from helpers.page_reader import PageReader
from helpers.turning_solids import solid, turning, write_recording
from objectflow.cli import main

COMMAND = ["--method", "consensus", "--camera", "static", "--report"]


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("turning") / "recording"
    write_recording(folder, turning(solid("box", (0.05, 0.07, 0.04)), 4, degrees=8))
    return folder


@pytest.fixture(scope="module")
def result(recording: Path) -> Path:
    out = recording.parent / "result"
    assert main(["run", str(recording), *COMMAND, "--models", "--out", str(out)]) == 0
    return out


def test_the_page_agrees_with_the_files_of_the_run(result: Path) -> None:
    reader = PageReader((result / "report.html").read_text(encoding="utf-8"))
    (track,) = json.loads((result / "tracks.json").read_text())["tracks"]
    (model,) = json.loads((result / "models" / "index.json").read_text())["objects"]
    poses = np.array(track["world_T_object"])
    shift = 100 * np.linalg.norm(poses[-1, :3, 3] - poses[0, :3, 3])
    row = reader.rows["1"]
    # The box turns in every pair; the pair that misses it has no label of it.
    assert row["steps"] == "3"
    assert track["labels"] == [0, 1, 0, 1]
    assert row["displacement"] == f"{shift:.1f}"
    assert row["extent"] == " x ".join(f"{100 * side:.1f}" for side in model["extent"])
    assert "4 frames, 3 pairs, something moved in 2 · 1 object followed" in reader.text
    assert reader.blocks["scene-data"]["objects"][0]["frames"] == [0, 1, 2, 3]
    links = [address for address in reader.addresses if not address.startswith(("#", "data:"))]
    assert "pair_000001_000002/overlay.png" in links
    assert {"tracks.json", "summary.csv", "models/index.json", "models/object_001.glb"} < set(links)
    assert all((result / address).is_file() for address in links)


def test_a_continued_run_writes_the_same_page(recording: Path, result: Path, tmp_path: Path) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(result, copy)
    (copy / "report.html").unlink()
    (copy / "tracks.json").unlink()
    shutil.rmtree(copy / "pair_000001_000002")
    shutil.rmtree(copy / "models")
    assert main(["run", str(recording), *COMMAND, "--models", "--out", str(copy)]) == 0
    assert (copy / "report.html").read_bytes() == (result / "report.html").read_bytes()


def test_a_run_without_models_and_pictures_has_a_page(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert main(["run", str(recording), *COMMAND, "--no-pictures", "--limit", "1", "--out", str(out)]) == 0
    assert f"report {out / 'report.html'}" in capsys.readouterr().out
    reader = PageReader((out / "report.html").read_text(encoding="utf-8"))
    assert reader.rows["1"]["extent"] == "–"
    assert "No model of this object." in reader.text
    assert not any("overlay" in address for address in reader.addresses)


def test_a_run_in_which_nothing_moves_has_a_page(recording: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    assert main(["run", str(recording), "--method", "zero", "--report", "--out", str(out)]) == 0
    reader = PageReader((out / "report.html").read_text(encoding="utf-8"))
    assert reader.rows == {}
    assert "No object moved." in reader.text
    assert reader.blocks["scene-data"]["objects"] == []
