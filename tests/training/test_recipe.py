"""Recipes: what they are, that every field can be replaced, and what they refuse."""

from __future__ import annotations

import dataclasses
import json
import math
from typing import Any

import pytest
import tyro

from objectflow.cli.train import Train, default
from objectflow.errors import TrainingError
from objectflow.networks import SceneFlowNet
from objectflow.training.recipe import RECIPES, Recipe, find_recipe


def parse(*words: str) -> Train:
    typed = ["--data", "somewhere", *words]
    return tyro.cli(Train, args=typed, default=default(typed))


def test_the_papers_recipe() -> None:
    recipe = find_recipe("paper")
    assert (recipe.optimizer, recipe.learning_rate, recipe.betas) == ("adam", 1e-4, (0.9, 0.999))
    assert (recipe.batch_size, recipe.size, recipe.precision, recipe.schedule) == (12, (240, 320), "fp32", "constant")
    assert [recipe.learning_rate_at(share) for share in (0.0, 0.3, 1.0)] == [1e-4] * 3
    loss = recipe.loss_settings
    assert (loss.rotation, loss.translation, loss.center, loss.flow, loss.radius, loss.trajectory) == (
        0.1, 100, 10, 10, 1, 1,
    )  # fmt: skip
    assert (loss.variance, loss.violation, loss.vl) == (0.1, 0.1, True)
    assert recipe.network_settings.trunk_width == 64


def test_variants_decide_over_network_and_losses() -> None:
    kinds = {name: dataclasses.replace(RECIPES["paper"], variant=name) for name in ("s", "c", "c-vl")}
    assert [one.network_settings.correlation for one in kinds.values()] == [False, True, True]
    assert [one.loss_settings.vl for one in kinds.values()] == [False, False, True]
    assert [one.method for one in kinds.values()] == ["sceneflownet-s", "sceneflownet-c", "sceneflownet-c-vl"]


def test_rotation_weight_is_one_for_losses_and_grouping() -> None:
    recipe = parse("--loss.rotation-weight", "0.1").settings
    assert recipe.grouping.rotation_weight == recipe.loss_settings.rotation_weight == 0.1


@pytest.mark.parametrize("name", RECIPES)
def test_every_field_can_be_replaced_from_the_command_line(name: str) -> None:
    assert parse("--recipe", name).settings == parse(f"--recipe={name}").settings == RECIPES[name]
    typed = parse(
        "--recipe", name, "--variant", "s", "--size", "96", "128", "--steps", "7", "--minutes", "2.5", "--clip",
        "None", "--learning-rate", "0.003",
        "--betas", "0.8", "0.9", "--no-compile", "--channels-last", "--precision", "bf16",
        "--network.reach", "4", "--network.down.1", "9", "8", "--network.trunk-norm", "frozen", "--loss.squared",
        "--augment.zoom", "1.5", "--augment.strength", "0", "1",
    ).settings  # fmt: skip
    before = RECIPES[name]
    down = (before.network.down[0], (9, 8), *before.network.down[2:])
    assert typed == dataclasses.replace(
        before, variant="s", size=(96, 128), steps=7, minutes=2.5, clip=None, learning_rate=0.003, betas=(0.8, 0.9),
        compile=False, channels_last=True, precision="bf16",
        network=dataclasses.replace(before.network, reach=4, down=down, trunk_norm="frozen"),
        loss=dataclasses.replace(before.loss, squared=True),
        augment=dataclasses.replace(before.augment, zoom=1.5, strength=(0.0, 1.0)),
    )  # fmt: skip


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"batch_size": 0}, "batch_size"),
        ({"learning_rate": 0.0}, "learning_rate"),
        ({"learning_rate": math.nan}, "learning_rate"),
        ({"steps": 0}, "steps"),
        ({"minutes": math.inf}, "minutes"),
        ({"weight_decay": -1.0}, "weight_decay"),
        ({"ema_decay": 1.0}, "ema_decay"),
        ({"betas": (0.9, 1.0)}, "betas"),
        ({"size": (4, 160)}, "size"),
        ({"variant": "d"}, "variant"),
        ({"precision": "fp16"}, "precision"),
    ],
)
def test_values_that_train_nothing_are_refused(changes: dict[str, Any], field: str) -> None:
    with pytest.raises(TrainingError, match=f"recipe field {field} must"):
        dataclasses.replace(RECIPES["cpu"], **changes)


def test_one_cycle_rises_in_a_line_and_falls_half_a_cosine() -> None:
    recipe = dataclasses.replace(RECIPES["cpu"], learning_rate=2.0, schedule="one-cycle", warm_up=0.2)
    at = recipe.learning_rate_at
    assert (at(0.0), at(0.1), at(0.2)) == pytest.approx((0.1, 1.05, 2.0))
    # Half way down, half way between the peak and a hundredth of it; a cosine is symmetric about that point.
    assert at(0.6) == pytest.approx((2.0 + 0.02) / 2)
    assert at(0.4) + at(0.8) == pytest.approx(2.0 + 0.02)
    assert at(0.4) == pytest.approx(0.02 + 1.98 * (1 + math.sqrt(0.5)) / 2)
    assert at(1.0) == pytest.approx(0.02)


def test_length_in_steps_passes_or_minutes() -> None:
    base = Recipe(passes=2.5)
    assert base.total_steps(100) == 250
    assert dataclasses.replace(base, steps=30).total_steps(100) == 30
    assert dataclasses.replace(base, minutes=5.0).total_steps(100) is None
    assert dataclasses.replace(base, minutes=5.0, steps=30).total_steps(100) == 30


def test_recipes_are_plain_json_and_networks_of_their_size() -> None:
    for recipe in RECIPES.values():
        assert json.loads(json.dumps(recipe.to_dict())) == recipe.to_dict()
    count = {name: _parameters(RECIPES[name]) for name in ("paper", "cpu")}
    assert count["cpu"] < count["paper"] / 4


def _parameters(recipe: Recipe) -> int:
    return sum(one.numel() for one in SceneFlowNet(recipe.network_settings).parameters())
