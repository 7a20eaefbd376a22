"""Learned methods and their options on the command line."""

from __future__ import annotations

import json
from importlib import resources
from pathlib import Path

import pytest

from helpers.small_networks import save, save_all
from objectflow.cli import main
from objectflow.cli.output import RESULT_FILES
from objectflow.methods import find_weights
from objectflow.motion import SceneMotion

PAIR = Path(str(resources.files("objectflow"))) / "demo" / "pair"
METHOD = ["--method", "sceneflownet-c-vl"]


@pytest.mark.parametrize("rigid", ["none", "average", "refine"])
def test_estimate_with_weights(tmp_path: Path, rigid: str) -> None:
    weights = save(tmp_path / "w.safetensors")
    out = tmp_path / "out"
    options = ["--weights", str(weights), "--rigid", rigid, "--device", "cpu", "--out", str(out)]
    assert main(["estimate", str(PAIR), *METHOD, *options]) == 0
    assert {path.name for path in out.iterdir()} == RESULT_FILES
    motion = SceneMotion.load(out)
    assert (motion.method, motion.labels.shape) == ("sceneflownet-c-vl", (480, 640))


def test_the_error_for_missing_weights_names_the_remedy(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv(find_weights.HUB_VARIABLE, raising=False)
    monkeypatch.setattr(find_weights, "packaged_folder", lambda: tmp_path / "none")
    assert main(["estimate", str(PAIR), *METHOD, "--out", str(tmp_path / "out")]) == 2
    (line,) = capfd.readouterr().err.splitlines()
    assert line.startswith("objectflow: no weights for sceneflownet-c-vl")
    assert "objectflow train" in line
    assert not list(tmp_path.iterdir())


def test_an_option_of_another_method_is_refused(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert main(["estimate", str(PAIR), "--method", "zero", "--rigid", "none", "--out", str(tmp_path / "o")]) == 2
    assert "unknown setting rigid" in capfd.readouterr().err


def test_a_run_is_not_continued_with_other_weights(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    weights, out = save(tmp_path / "w.safetensors"), tmp_path / "out"
    command = ["run", str(PAIR), *METHOD, "--weights", str(weights), "--out", str(out)]
    assert main(command) == 0
    assert main(command) == 0
    assert json.loads((out / "settings.json").read_text())["weights_sha256"]
    capfd.readouterr()
    assert main([*command, "--rigid", "none"]) == 2
    assert "was made with rigid = None, now it is none" in capfd.readouterr().err
    save(weights, size=[96, 128])
    assert main(command) == 2
    assert "was made with weights_sha256" in capfd.readouterr().err


def test_info_and_methods_list_the_networks(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    save_all(tmp_path)
    (tmp_path / "broken.safetensors").write_bytes(b"nothing")
    monkeypatch.setattr(find_weights, "packaged_folder", lambda: tmp_path)
    monkeypatch.setenv("COLUMNS", "400")
    assert main(["info"]) == 0
    out = capfd.readouterr().out
    assert "sceneflownet-c-vl (" in out
    assert "frames resized to 160x120" in out
    assert "broken (damaged" in out
    assert main(["methods"]) == 0
    listed = capfd.readouterr().out
    assert all(name in listed for name in ("sceneflownet-s", "sceneflownet-c", "sceneflownet-c-vl"))
