"""Every recipe of docs/recipes.md runs as printed, section by section, and does what it says."""

from __future__ import annotations

import json
import re
import shlex
from importlib import resources
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import objectflow
from helpers.paths import ROOT
from objectflow import geometry
from objectflow.cli import main

PAGE = ROOT / "docs" / "recipes.md"
SECTIONS = dict(re.findall(r"^## (.+?)\n(.*?)(?=^## |\Z)", PAGE.read_text(), flags=re.DOTALL | re.MULTILINE))


def run(title: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """The names that a section's Python blocks leave behind, run in a folder of its own."""
    monkeypatch.chdir(folder)
    names: dict[str, Any] = {}
    for language, code in re.findall(r"```(\w+)\n(.*?)```", SECTIONS[title], flags=re.DOTALL):
        if language == "python":
            exec(compile(code, f"recipes.md: {title}", "exec"), names)
        else:
            for line in code.splitlines():
                words = shlex.split(line)
                assert words[0] == "objectflow"
                assert main(words[1:]) == 0, line
    return names


def true_label(name: str) -> np.ndarray[Any, np.dtype[np.bool_]]:
    with np.load(str(resources.files("objectflow") / "demo" / "pair" / "truth.npz")) as truth:
        return np.asarray(truth["labels1"] == 1 + truth["names"].tolist().index(name))


def test_the_page_has_five_recipes_and_no_block_that_is_not_run() -> None:
    assert len(SECTIONS) == 5
    assert set(re.findall(r"^```(\w+)", PAGE.read_text(), flags=re.MULTILINE)) == {"python", "bash"}


def test_a_pair_from_arrays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    motion = run("A pair from arrays", tmp_path, monkeypatch)["motion"]
    assert len(motion.objects) == 3
    assert np.array_equal(objectflow.SceneMotion.load(tmp_path / "result").labels, motion.labels)


def test_the_grasp_is_on_an_object_that_moved_and_no_wider_than_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    names = run("A mask for grasping", tmp_path, monkeypatch)
    u, v = np.rint(geometry.project(names["grasp_point"], names["curr"].camera)).astype(int)
    things = {name: true_label(name) for name in ("tea box", "can", "ball")}
    (hit,) = [name for name, mask in things.items() if mask[v, u]]
    # As wide as what is seen of the thing, less the eroded rim.
    curr = names["curr"]
    seen = geometry.back_project(curr.depth, curr.camera)[things[hit] & curr.valid]
    assert 0.7 < names["width"] / np.ptp(seen @ names["closing"]) < 1.02
    saved = cv2.imread(str(tmp_path / "mask.png"), cv2.IMREAD_UNCHANGED) > 0
    assert (saved & things[hit]).sum() > 0.8 * (saved | things[hit]).sum()


def test_points_of_one_object_agree_with_the_true_motion(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    names = run("Points of one object in both frames", tmp_path, monkeypatch)
    with np.load(str(resources.files("objectflow") / "demo" / "pair" / "truth.npz")) as truth:
        off = [np.median(np.linalg.norm(names["before"] - geometry.transform(T, names["now"]), axis=1))
               for T in truth["prev_T_curr"][truth["moving"]]]  # fmt: skip
    assert min(off) < 0.002
    assert names["pixels_before"].shape == (len(names["now"]), 2)
    assert np.allclose(geometry.transform(names["curr_T_prev"], names["before"]), names["now"], atol=1e-6)


def test_a_loop_over_a_camera_leaves_a_trajectory_an_object(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    names = run("A loop over a camera", tmp_path, monkeypatch)
    tracks = json.loads((tmp_path / "tracks.json").read_text())["tracks"]
    assert [track["times"] for track in tracks] == [[0.0, 0.5]] * 3
    assert sorted(path.name for path in (tmp_path / "trajectories").iterdir()) == [
        f"object_{index:03d}.txt" for index in (1, 2, 3)
    ]
    assert sorted(names["ids"].values()) == [1, 2, 3]


def test_training_on_own_meshes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for module in ("mujoco", "mujoco_warp", "trimesh", "coacd"):
        pytest.importorskip(module, reason='needs the extra "synth"')
    motion = run("Training on your own meshes", tmp_path, monkeypatch)["motion"]
    assert motion.method == "sceneflownet-c-vl"
    models = json.loads((tmp_path / "own" / "manifest.json").read_text())
    assert models["settings"]["meshes"] == "meshes"
