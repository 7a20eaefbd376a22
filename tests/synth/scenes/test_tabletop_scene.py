"""Tabletop scenes: drawn from one seed, disjoint models in the splits, scaled as a whole; bad settings are refused."""

from __future__ import annotations

import numpy as np
import pytest

from objectflow.errors import DatasetError
from objectflow.synth.objects.procedural import ProceduralLibrary
from objectflow.synth.scenes.arm_motion import HELD_KINDS
from objectflow.synth.scenes.tabletop_scene import TabletopScene, TabletopSettings, draw_tabletop_scene, scaled_scene

SETTINGS = TabletopSettings()


def draw(seed: int, split: str = "val", *, motionless: bool = False) -> TabletopScene:
    rng = np.random.default_rng(seed)
    return draw_tabletop_scene(rng, ProceduralLibrary(), split, SETTINGS, motionless=motionless)


def test_the_same_seed_gives_the_same_scene() -> None:
    one, same = draw(3), draw(3)
    assert one.scene == same.scene
    assert one.actions == same.actions
    assert [plan for _, plan in one.arms] == [plan for _, plan in same.arms]
    assert draw(4).scene != one.scene


def test_actions_have_their_own_objects_and_arms_carry_out_what_hands_can() -> None:
    kinds, categories, arms = set(), set(), set()
    for seed in range(60):
        drawn = draw(seed)
        targets = [action.object for action in drawn.actions]
        assert len(set(targets)) == len(targets)
        assert 1 <= len(targets) <= 3
        assert max(targets) < drawn.free == len(drawn.models) - len(drawn.arms) - 1
        held = [plan.action for _, plan in drawn.arms if plan.action is not None]
        assert len({action.object for action in held}) == len(held)
        assert all(action in drawn.actions and action.kind in HELD_KINDS for action in held)
        for action in drawn.actions:
            if drawn.models[action.object].category == "package" and action.kind in ("slide", "carry"):
                assert 0.1 <= action.path <= 0.3
        kinds |= {action.kind for action in drawn.actions}
        categories |= {model.category for model in drawn.models}
        arms.add(len(drawn.arms))
    assert {"slide", "carry", "turn", "lift", "push", "topple", "fall"} == kinds
    assert {"package", "arm", "robot-arm", "shadow-caster"} < categories
    assert arms == {0, 1, 2}


def test_in_scenes_without_motion_arms_rest() -> None:
    plans = [plan for seed in range(20) for _, plan in draw(seed, motionless=True).arms]
    assert plans
    for plan in plans:
        assert plan.action is None
        assert plan.begin == plan.end
        assert plan.twist == (0, 0, 0)


def test_packages_and_arms_of_the_splits_are_disjoint() -> None:
    names = {
        split: {model.name for seed in range(25) for model in draw(seed, split).models if "-0" in model.name}
        for split in ("train", "val", "test")
    }
    assert not names["train"] & names["val"]
    assert not names["train"] & names["test"]
    assert not names["val"] & names["test"]


def test_a_scaled_scene_looks_the_same_from_its_scaled_camera() -> None:
    scene = draw(5).scene
    far = scaled_scene(scene, 2.5)
    for a, b in zip(scene.views, far.views, strict=True):
        np.testing.assert_allclose(b.world_T_camera[:3, :3], a.world_T_camera[:3, :3])
        np.testing.assert_allclose(b.world_T_camera[:3, 3], 2.5 * a.world_T_camera[:3, 3])
    for before, after in zip(scene.slabs, far.slabs, strict=True):
        np.testing.assert_allclose(after.center, 2.5 * np.asarray(before.center))
        np.testing.assert_allclose(after.half, 2.5 * np.asarray(before.half))
        assert after.surface.tile == pytest.approx(2.5 * before.surface.tile)
    assert far.floor.height == pytest.approx(2.5 * scene.floor.height)
    assert [item.scale for item in far.objects] == pytest.approx([2.5 * item.scale for item in scene.objects])


def test_invalid_settings_are_refused() -> None:
    with pytest.raises(DatasetError, match="movers and gap"):
        TabletopSettings(gap=(0, 3))
    with pytest.raises(DatasetError, match="actions is a range"):
        TabletopSettings(actions=(2, 1))
    with pytest.raises(DatasetError, match="shares must be within 0 and 1"):
        TabletopSettings(motionless=1.5)
    with pytest.raises(DatasetError, match="must sum to 1"):
        TabletopSettings(arms=(0.5, 0.2, 0.2))
