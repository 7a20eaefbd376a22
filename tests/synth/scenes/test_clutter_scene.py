"""Clutter scenes: drawn from one seed, with actions on different objects; invalid settings are refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from objectflow.errors import DatasetError
from objectflow.synth.objects.procedural import ProceduralLibrary
from objectflow.synth.scenes.clutter_scene import SCENE, ClutterScene, ClutterSettings, draw_clutter_scene

SETTINGS = ClutterSettings(replace(SCENE, objects=(2, 5)))


def draw(seed: int, *, motionless: bool = False) -> ClutterScene:
    rng = np.random.default_rng(seed)
    return draw_clutter_scene(rng, ProceduralLibrary(), "val", SETTINGS, motionless=motionless)


def test_the_same_seed_gives_the_same_scene() -> None:
    one, same = draw(3), draw(3)
    assert one.scene == same.scene
    assert one.actions == same.actions
    assert draw(4).scene != one.scene


def test_each_action_has_its_own_object() -> None:
    assert draw(3, motionless=True).actions == ()
    for seed in range(20):
        drawn = draw(seed)
        targets = [action.object for action in drawn.actions]
        assert len(set(targets)) == len(targets) <= 8
        assert all(0 <= target < len(drawn.scene.objects) for target in targets)


def test_invalid_settings_are_refused() -> None:
    with pytest.raises(DatasetError, match="movers and gap"):
        ClutterSettings(gap=(0, 3))
    with pytest.raises(DatasetError, match="shares"):
        ClutterSettings(motionless=1.5)
