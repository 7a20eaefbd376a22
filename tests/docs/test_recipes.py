"""Every recipe of docs/recipes.md runs as printed and gives the result that it describes."""

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
    """Run the blocks of a section in a folder; return the global names of its Python blocks."""
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


def test_the_page_has_five_recipes_whose_blocks_all_run() -> None:
    assert len(SECTIONS) == 5
    assert set(re.findall(r"^```(\w+)", PAGE.read_text(), flags=re.MULTILINE)) == {"python", "bash"}


def test_a_pair_from_arrays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    motion = run("A pair from arrays", tmp_path, monkeypatch)["motion"]
    assert len(motion.objects) == 3
    assert np.array_equal(objectflow.SceneMotion.load(tmp_path / "result").labels, motion.labels)


def test_the_grasp_is_on_a_moving_object_and_not_wider(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    names = run("A mask for grasping", tmp_path, monkeypatch)
    u, v = np.rint(geometry.project(names["grasp_point"], names["curr"].camera)).astype(int)
    masks = {name: true_label(name) for name in ("tea box", "can", "ball")}
    (grasped,) = [name for name, mask in masks.items() if mask[v, u]]
    # The width is that of the visible surface without the eroded rim.
    curr = names["curr"]
    surface = geometry.back_project(curr.depth, curr.camera)[masks[grasped] & curr.valid]
    assert 0.7 < names["width"] / np.ptp(surface @ names["closing"]) < 1.02
    saved = cv2.imread(str(tmp_path / "mask.png"), cv2.IMREAD_UNCHANGED) > 0
    assert (saved & masks[grasped]).sum() > 0.8 * (saved | masks[grasped]).sum()


def test_points_of_one_object_agree_with_the_true_motion(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    names = run("Points of one object in both frames", tmp_path, monkeypatch)
    with np.load(str(resources.files("objectflow") / "demo" / "pair" / "truth.npz")) as truth:
        errors = [np.median(np.linalg.norm(names["before"] - geometry.transform(T, names["now"]), axis=1))
                  for T in truth["prev_T_curr"][truth["moving"]]]  # fmt: skip
    assert min(errors) < 0.002
    assert names["pixels_before"].shape == (len(names["now"]), 2)
    assert np.allclose(geometry.transform(names["curr_T_prev"], names["before"]), names["now"], atol=1e-6)


def test_a_loop_over_a_camera_writes_one_trajectory_per_object(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
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
