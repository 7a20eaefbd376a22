"""The names of live cameras: every entry has a driver and an extra, and misspelt names are answered."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

from helpers.paths import ROOT
from objectflow.cli import main
from objectflow.errors import ReaderError
from objectflow.readers.camera_driver import StreamRequest
from objectflow.readers.camera_registry import CAMERAS, make_driver


def test_unknown_cameras_are_answered_with_the_choices() -> None:
    with pytest.raises(ReaderError, match="unknown camera 'orbec': did you mean 'orbbec'\\? choose one of realsense"):
        make_driver("orbec")
    with pytest.raises(ReaderError, match="unknown camera 'kinect': choose one of realsense, orbbec, oak"):
        make_driver("kinect")


@pytest.mark.parametrize("name", CAMERAS)
def test_every_camera_has_a_driver_and_an_extra(name: str) -> None:
    # The modules import the cameras' libraries, which are not installed here.
    path = ROOT / "src" / CAMERAS[name].module.replace(".", "/")
    classes = [
        node for node in ast.walk(ast.parse(path.with_suffix(".py").read_text())) if isinstance(node, ast.ClassDef)
    ]
    bases = {node.name: [base.id for base in node.bases if isinstance(base, ast.Name)] for node in classes}
    assert bases[CAMERAS[name].driver] == ["CameraDriver"]
    assert f'"{name}")' in path.with_suffix(".py").read_text()
    assert f"\n{name} = [" in (ROOT / "pyproject.toml").read_text()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["realsens"], "realsens: no such folder, recording or camera: did you mean 'realsense'? cameras: realsense"),
        (["oka:x"], "oka:x: no such folder, recording or camera: did you mean 'oak'?"),
        (["orbbec:a.bag"], "orbbec:a.bag: only recordings of realsense can be played"),
        (["nowhere"], "nowhere: no such folder"),
        ([".", "--serial", "1"], "--serial, --size and --rate are for cameras (realsense, orbbec, oak)"),
        (["realsense:a.bag", "--rate", "30"], "--serial, --size and --rate are for cameras"),
    ],
)
def test_names_of_sources(
    words: list[str], message: str, capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["live", *words, "--method", "zero"]) == 2
    assert capsys.readouterr().err.startswith(f"objectflow: {message}")


def test_requests_are_checked() -> None:
    with pytest.raises(ReaderError, match="must be positive"):
        StreamRequest(size=(640, 0))
    with pytest.raises(ReaderError, match="must be positive"):
        StreamRequest(rate=0)
