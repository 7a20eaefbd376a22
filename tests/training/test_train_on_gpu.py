"""The script for a short time on a GPU: the sizes of its sets, and the copies of its weights."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import pytest

import train_on_gpu
from train_on_gpu import CLOSING, PRESETS, Settings, copy_newest, plan


def test_sets_fill_their_share_of_the_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With cores that make two pairs a second and start in three seconds."""
    clock, made = [0.0], dict.fromkeys(PRESETS, 0)

    def generate(settings: Settings, folder: str, split: str, pairs: int) -> None:
        before = made[folder] if split == "train" else 0
        clock[0] += 3 + (pairs - before) / 2
        if split == "train":
            made[folder] = pairs

    monkeypatch.setattr(train_on_gpu, "generate", generate)
    monkeypatch.setattr(train_on_gpu.time, "monotonic", lambda: clock[0])
    settings = Settings(tmp_path, minutes=20, generation_share=0.5, validation_pairs=20, workers=2)
    found = plan(settings)
    assert {folder: found[folder] for folder in PRESETS} == made
    validation = 3 + 20 / 2
    assert 0.9 * 600 < clock[0] - validation < 1.02 * 600
    assert made["data"] > made["clutter"] == made["tabletop"]
    assert found["minutes"] == pytest.approx(20 - clock[0] / 60 - CLOSING)
    # The plan is carried out again by the same command, whose sets are complete already.
    ended = clock[0]
    assert plan(dataclasses.replace(settings, minutes=1)) == found == json.loads((tmp_path / "plan.json").read_text())
    assert clock[0] == ended


def test_the_newest_weights_are_copied(tmp_path: Path) -> None:
    target = tmp_path / "weights.safetensors"
    copy_newest(tmp_path, target)
    assert not target.exists()
    for step in (9, 10, 2):
        folder = tmp_path / "checkpoints" / f"step-{step:08d}"
        folder.mkdir(parents=True)
        (folder / "weights.safetensors").write_bytes(b"%d" % step)
    copy_newest(tmp_path, target)
    assert target.read_bytes() == b"10"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["checkpoints", "weights.safetensors"]
