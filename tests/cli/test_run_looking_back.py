"""`objectflow run` with objects that are found later: completed masks, and estimates between frames farther apart."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from helpers.plate_recordings import PLATE_PATH, missing_steps, write_plates
from helpers.plate_scenes import iou
from objectflow.cli import main
from objectflow.cli.run import KNOWN


def test_known_objects_are_added_to_the_frames_before_the_one_in_which_they_were_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The method misses the first steps of a plate; an interrupted run is completed to the same files."""
    folder, out = tmp_path / "sequence", tmp_path / "out"
    scene = write_plates(folder, PLATE_PATH)
    monkeypatch.setattr("objectflow.cli.arguments.load", lambda *_, **__: missing_steps(scene, first=5))
    words = ["run", str(folder), "--intrinsics", "150,150,79.5,59.5", "--depth-scale", "1000", "--out", str(out)]
    assert main(words) == 0
    masks = {number: cv2.imread(str(out / pair_name(number) / KNOWN), cv2.IMREAD_UNCHANGED) for number in range(1, 7)}
    for number in range(1, 7):
        assert iou(masks[number] == 1, scene.labels[number] == 1) > 0.85
    (track,) = json.loads((out / "tracks.json").read_text())["tracks"]
    assert track["times"] == [1, 2, 3, 4, 5, 6]
    before = contents(out)
    # Killed before the masks were completed, and then in the frame in which the plate was found.
    cv2.imwrite(str(out / pair_name(3) / KNOWN), np.zeros_like(masks[3]))
    shutil.rmtree(out / pair_name(6))
    assert main(words) == 0
    assert contents(out) == before


def test_an_estimate_between_frames_farther_apart_is_kept_by_a_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The method sees the plate between every second frame only; such an estimate is not repeated."""
    folder, out = tmp_path / "sequence", tmp_path / "out"
    scene = write_plates(folder, PLATE_PATH)
    calls: list[tuple[int, int]] = []
    monkeypatch.setattr("objectflow.cli.arguments.load", lambda *_, **__: missing_steps(scene, gap=2, calls=calls))
    words = ["run", str(folder), "--intrinsics", "150,150,79.5,59.5", "--depth-scale", "1000", "--out", str(out)]
    assert main(words) == 0
    (kept,) = out.glob("pair_*/since_*")
    assert [(prev, curr) for prev, curr in calls if curr > prev + 1] == [
        (int(kept.name[-6:]), int(kept.parent.name[-6:]))
    ]
    (track,) = json.loads((out / "tracks.json").read_text())["tracks"]
    assert len(track["times"]) > 2
    before = contents(out)
    calls.clear()
    shutil.rmtree(out / pair_name(6))
    assert main(words) == 0
    assert calls == [(5, 6)]
    assert contents(out) == before


def pair_name(curr: int) -> str:
    return f"pair_{curr - 1:06d}_{curr:06d}"


def contents(folder: Path) -> dict[str, bytes]:
    """The files that hold no measured times."""
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and (path.suffix in (".png", ".npy", ".txt") or path.name == "tracks.json")
    }
