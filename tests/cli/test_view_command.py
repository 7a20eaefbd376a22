"""`objectflow view` and `--save-view`: results, runs and data sets as .rrd files; one-line errors."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterable
from importlib import resources
from pathlib import Path

import cv2
import numpy as np
import pytest

from objectflow.cli import main
from objectflow.view.viewer import NoViewer, open_viewer
from objectflow.view.viewer_frames import ViewerFrame

chunk = pytest.importorskip("rerun.chunk", reason="rerun is not installed (extra `view`)")

ROOT = Path(str(resources.files("objectflow")))
PAIR = ROOT / "demo" / "pair"
TINY = ROOT / "evaluation" / "tiny"


def frames_of(path: Path, entity: str = "/world/camera/color") -> list[int]:
    """The frame numbers at which a recording has an entity."""
    numbers: set[int] = set()
    for part in chunk.RrdReader(str(path)).stream():
        if part.entity_path == entity:
            numbers |= set(part.to_record_batch().column("frame").to_pylist())
    return sorted(numbers)


def entities_of(path: Path) -> set[str]:
    """The entities of a recording."""
    return {part.entity_path for part in chunk.RrdReader(str(path)).stream()}


@pytest.fixture
def sequence(tmp_path: Path) -> Path:
    """A sequence of three small frames of a wall."""
    rng = np.random.default_rng(3)
    folder = tmp_path / "sequence"
    for name in ("color", "depth"):
        (folder / name).mkdir(parents=True)
    for index in range(3):
        cv2.imwrite(str(folder / "color" / f"{index}.png"), rng.integers(0, 255, (48, 64, 3), dtype=np.uint8))
        cv2.imwrite(str(folder / "depth" / f"{index}.png"), np.full((48, 64), 1000, np.uint16))
    camera = {"width": 64, "height": 48, "fx": 60.0, "fy": 60.0, "cx": 31.5, "cy": 23.5, "depth_scale": 1000}
    (folder / "camera.json").write_text(json.dumps(camera))
    return folder


def test_a_run_is_recorded_while_running_and_viewed_afterwards(sequence: Path, tmp_path: Path) -> None:
    out, while_running, later = tmp_path / "out", tmp_path / "a.rrd", tmp_path / "b.rrd"
    command = ["run", str(sequence), "--method", "zero", "--out", str(out)]
    assert main([*command, "--save-view", str(while_running)]) == 0
    assert frames_of(while_running) == [0, 1, 2]
    assert main([*command, "--save-view", str(later)]) == 0  # All pairs are finished.
    assert frames_of(later) == [0, 1, 2]
    assert main(["view", str(out), "--save", str(later)]) == 0
    assert frames_of(later) == [0, 1, 2]
    assert main(["view", str(out / "pair_000001_000002"), "--save", str(later)]) == 0
    assert frames_of(later) == [1, 2]


def test_a_moved_source_is_reported_and_can_be_given(
    sequence: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, saved = tmp_path / "out", tmp_path / "a.rrd"
    assert main(["run", str(sequence), "--method", "zero", "--out", str(out)]) == 0
    moved = sequence.rename(tmp_path / "moved")
    capsys.readouterr()
    assert main(["view", str(out), "--save", str(saved)]) == 2
    assert "--frames SOURCE" in capsys.readouterr().err
    assert main(["view", str(out), "--frames", str(moved), "--save", str(saved)]) == 0
    assert frames_of(saved) == [0, 1, 2]


def test_a_result_finds_its_frames_unless_they_were_moved(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pair, out, saved = tmp_path / "pair", tmp_path / "out", tmp_path / "a.rrd"
    shutil.copytree(PAIR, pair)
    command = ["estimate", str(pair), "--method", "zero", "--out", str(out), "--save-view", str(saved)]
    assert main(command) == 0
    assert frames_of(saved) == [0, 1]
    saved.unlink()
    assert main(["view", str(out), "--save", str(saved)]) == 0
    assert frames_of(saved) == [0, 1]
    pair.rename(tmp_path / "moved")
    capsys.readouterr()
    assert main(["view", str(out), "--save", str(saved)]) == 2
    error = capsys.readouterr().err
    assert "--frames" in error
    assert error.count("\n") == 1
    assert main(["view", str(out), "--frames", str(tmp_path / "moved"), "--save", str(saved)]) == 0
    assert frames_of(saved) == [0, 1]


def test_a_data_set_shows_its_truth(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    saved = tmp_path / "a.rrd"
    assert main(["view", str(TINY), "--save", str(saved)]) == 0
    assert frames_of(saved) == [0, 1]
    assert any(path.startswith("/world/objects/") for path in entities_of(saved))
    assert main(["view", str(TINY), "--key", "nothing", "--save", str(saved)]) == 2
    assert "no row 'nothing'" in capsys.readouterr().err


def test_errors_are_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "broken").mkdir()
    (tmp_path / "broken" / "settings.json").write_text("[]")
    (tmp_path / "broken" / "pair_000000_000001").mkdir()
    for path, words, code in (
        (tmp_path / "nowhere", "no such folder", 2),
        (tmp_path / "empty", "nothing to view", 2),
        (tmp_path / "broken", "not the settings of a run", 2),
        (TINY, "cannot write", 1),
    ):
        assert main(["view", str(path), "--save", str(tmp_path / "no_folder" / "a.rrd")]) == code
        error = capsys.readouterr().err
        assert words in error
        assert error.count("\n") == 1


DEMO_ENTITIES = {
    *(f"/world/camera{part}" for part in ("", "/color", "/depth", "/labels")),
    *("/world/points/by_object", "/world/points/by_flow", "/world/points/by_color/modelled"),
    *("/world/points/by_color/rest", "/world/motion", "/world/captions", "/world/trails"),
    *(f"/world/objects/00{number}" for number in (1, 2, 3)),
}
"""Entities of a recording of the demo pair, in which three objects move."""


@pytest.mark.parametrize("command", ["estimate", "run", "live"])
def test_results_are_recorded_by_save_view(command: str, tmp_path: Path) -> None:
    saved = tmp_path / "a.rrd"
    gap = ["--min-gap", "0"] if command == "live" else []
    assert main([command, str(PAIR), "--out", str(tmp_path / "out"), "--save-view", str(saved), *gap]) == 0
    assert entities_of(saved) >= DEMO_ENTITIES
    assert frames_of(saved) == [0, 1]
    assert frames_of(saved, "/world/objects/003") == [0, 1]


@pytest.mark.parametrize("command", ["estimate", "run", "live"])
def test_a_window_opens_only_with_view(command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    requested: list[dict[str, object]] = []
    shown: list[ViewerFrame] = []

    class Window(NoViewer):
        def show(self, make: Callable[[], Iterable[ViewerFrame]]) -> None:
            shown.extend(make())

    def open_fake(title: str, **options: object) -> NoViewer:
        requested.append({"title": title, **options})
        null_viewer = open_viewer(title, window=False)
        assert isinstance(null_viewer, NoViewer)
        return Window() if options["window"] else null_viewer

    monkeypatch.setattr("objectflow.view.viewer.open_viewer", open_fake)
    words = [command, str(PAIR), "--method", "zero", *(["--min-gap", "0"] if command == "live" else [])]
    assert main([*words, "--out", str(tmp_path / "off")]) == 0
    assert shown == []
    assert main([*words, "--out", str(tmp_path / "on"), "--view"]) == 0
    assert [frame.number for frame in shown] == [0, 1]
    assert requested == [{"title": "pair", "window": window, "save": None} for window in (False, True)]


def test_the_error_for_a_missing_display_names_the_alternatives(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.setattr("sys.platform", "linux")
    assert main(["view", str(TINY)]) == 2
    assert "--web" in capsys.readouterr().err
