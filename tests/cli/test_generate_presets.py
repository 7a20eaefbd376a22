"""The preset `clutter` under its former name `wild`: sets of that name are continued under either name."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from helpers.fake_scenes import FakeScenes
from objectflow.cli import main
from objectflow.dataset.manifest import VERSION, Manifest
from objectflow.dataset.shards import write_shard
from objectflow.synth.generation.tasks import Task

pytest.importorskip("mujoco_warp", reason="generating needs the extra [synth]")

OLD_SETTINGS: dict[str, Any] = {
    "meshes": None,
    "preset": "wild",
    "samples": 1,
    "scene": {
        "density": [200.0, 900.0],
        "distance": [0.35, 1.3],
        "drop_height": 0.01,
        "elevation": [15.0, 90.0],
        "focal": [215.0, 310.0],
        "height": 240,
        "image_share": 0.6,
        "lights": [1, 4],
        "objects": [1, 20],
        "principal_shift": 6.0,
        "roll": [-6.0, 6.0],
        "size": [0.04, 0.3],
        "size_jitter": 1.4,
        "spread": 0.65,
        "views": 8,
        "width": 320,
    },
    "textures": None,
    "wild": {
        "camera_shift": [0.01, 0.05],
        "camera_turn": [1.0, 5.0],
        "gap": [3, 60],
        "motionless": 0.125,
        "movers": [1, 8],
        "moving_camera": 0.25,
        "object_images": 0.25,
        "spread": [0.5, 2.2],
        "upright": 0.5,
    },
}
"""Settings as they were recorded in shards and manifest under the former name."""


@pytest.fixture
def old_set(tmp_path: Path) -> Path:
    """A finished shard of one pair with the recorded settings of the former name."""
    identity = {"kind": "pairs", "split": "test", "count": 1, "rows_a_scene": 1}
    metadata = {"version": VERSION, "seed": 9, "settings": OLD_SETTINGS, **identity, "rejected": {}}
    rows = FakeScenes().make(Task("pairs", 0)).rows
    folder = tmp_path / "old"
    folder.mkdir()
    write_shard(folder / "test-00000-of-00001.parquet", rows, "pairs", metadata)
    return folder


@pytest.mark.parametrize("preset", ["wild", "clutter"])
def test_a_set_of_the_former_name_is_continued_under_either_name(old_set: Path, preset: str) -> None:
    shard = old_set / "test-00000-of-00001.parquet"
    before = shard.read_bytes()
    words = ["generate", "--out", str(old_set), "--preset", preset, "--split", "test", "--pairs", "1"]
    assert main([*words, "--samples", "1", "--seed", "9", "--workers", "1"]) == 0
    assert shard.read_bytes() == before
    settings = json.loads((old_set / "manifest.json").read_text())["settings"]
    assert settings["preset"] == "clutter"
    assert settings["clutter"] == OLD_SETTINGS["wild"]
    assert "wild" not in settings
    assert Manifest.read(old_set).parts["test"].rows == 1


def test_other_settings_than_those_of_the_old_set_are_refused(
    old_set: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["generate", "--out", str(old_set), "--preset", "clutter", "--split", "test", "--pairs", "1"]
    assert main([*words, "--samples", "4", "--seed", "9", "--workers", "1"]) == 2
    assert "holds shards of samples 1, not 4" in capsys.readouterr().err
