"""Recipes: the paper's values, replacement of every field from the command line, and refused values."""

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
from objectflow.training.model_config import VARIANTS, RigidMatchModel, SceneFlowNetModel
from objectflow.training.recipe import Recipe
from objectflow.training.recipes import RECIPES, find_recipe


def parse(*words: str) -> Train:
    typed = ["--data", "somewhere", *words]
    return tyro.cli(Train, args=typed, default=default(typed))


def paper_model(name: str) -> SceneFlowNetModel:
    model = RECIPES[name].model
    assert isinstance(model, SceneFlowNetModel)
    return model


def test_the_papers_recipe() -> None:
    recipe = find_recipe("paper")
    assert (recipe.optimizer, recipe.learning_rate, recipe.betas) == ("adam", 1e-4, (0.9, 0.999))
    assert (recipe.batch_size, recipe.size, recipe.precision, recipe.schedule) == (12, (240, 320), "fp32", "constant")
    assert [recipe.learning_rate_at(share) for share in (0.0, 0.3, 1.0)] == [1e-4] * 3
    loss = paper_model("paper").loss
    assert (loss.rotation, loss.translation, loss.center, loss.flow, loss.radius, loss.trajectory) == (
        0.1, 100, 10, 10, 1, 1,
    )  # fmt: skip
    assert (loss.variance, loss.violation, loss.vl) == (0.1, 0.1, True)
    assert paper_model("paper").network.trunk_width == 64


@pytest.mark.parametrize("name", RECIPES)
def test_a_variant_chooses_the_network_and_its_losses(name: str) -> None:
    models: dict[str, Any] = {variant: find_recipe(name, variant).model for variant in VARIANTS}
    papers = [models[variant] for variant in ("s", "c", "c-vl")]
    assert [model.network.correlation for model in papers] == [False, True, True]
    assert [model.loss.vl for model in papers] == [False, False, True]
    assert models["c-vl"] == RECIPES[name].model
    # Nothing else differs.
    assert [model.with_variant("c-vl") for model in papers] == [models["c-vl"]] * 3
    assert models["rigidmatch"] == RigidMatchModel()
    assert [model.method for model in models.values()] == [
        "sceneflownet-s", "sceneflownet-c", "sceneflownet-c-vl", "rigidmatch",
    ]  # fmt: skip
    assert [model.variant for model in models.values()] == list(VARIANTS)


def test_unknown_names_are_refused_with_the_choices() -> None:
    with pytest.raises(TrainingError, match="unknown recipe 'tpu': choose one of paper, gpu, cpu"):
        find_recipe("tpu")
    with pytest.raises(TrainingError, match="unknown variant 'd': choose one of s, c, c-vl, rigidmatch"):
        find_recipe("cpu", "d")
    with pytest.raises(TrainingError, match="unknown variant 'd'"):
        parse("--variant", "d")


def test_variance_and_violation_need_correlation() -> None:
    with pytest.raises(TrainingError, match=r"model\.loss\.vl must be off where model\.network\.correlation is"):
        parse("--model.network.no-correlation")
    assert parse("--model.network.no-correlation", "--model.loss.no-vl").settings == find_recipe("cpu", "s")


def test_rotation_weight_is_one_for_losses_and_grouping() -> None:
    model: Any = parse("--model.loss.rotation-weight", "0.1").settings.model
    assert model.grouping.rotation_weight == model.rotation_weight == model.loss.rotation_weight == 0.1


@pytest.mark.parametrize("name", RECIPES)
def test_every_field_can_be_replaced_from_the_command_line(name: str) -> None:
    assert parse("--recipe", name).settings == parse(f"--recipe={name}").settings == RECIPES[name]
    typed = parse(
        "--recipe", name, "--variant", "s", "--size", "96", "128", "--steps", "7", "--minutes", "2.5", "--clip",
        "None", "--learning-rate", "0.003",
        "--betas", "0.8", "0.9", "--no-compile", "--channels-last", "--precision", "bf16",
        "--model.network.reach", "4", "--model.network.down.1", "9", "8", "--model.network.trunk-norm", "frozen",
        "--model.loss.squared", "--augment.zoom", "1.5", "--augment.strength", "0", "1",
    )  # fmt: skip
    before = find_recipe(name, "s")
    network, loss = before.model.network, before.model.loss
    down = (network.down[0], (9, 8), *network.down[2:])
    assert typed.variant == "s"
    assert typed.settings == dataclasses.replace(
        before, size=(96, 128), steps=7, minutes=2.5, clip=None, learning_rate=0.003, betas=(0.8, 0.9),
        compile=False, channels_last=True, precision="bf16",
        model=SceneFlowNetModel(
            dataclasses.replace(network, reach=4, down=down, trunk_norm="frozen"),
            dataclasses.replace(loss, squared=True),
        ),
        augment=dataclasses.replace(before.augment, zoom=1.5, strength=(0.0, 1.0)),
    )  # fmt: skip


@pytest.mark.parametrize("name", RECIPES)
def test_every_field_of_the_other_network_can_be_replaced_too(name: str) -> None:
    before = find_recipe(name, "rigidmatch")
    assert parse("--recipe", name, "--variant=rigidmatch").settings == before
    words = ("--model.network.queries", "7", "--model.network.xfeat", "none", "--model.loss.match", "3")
    typed = parse("--variant", "rigidmatch", "--recipe", name, *words).settings
    assert typed.model == RigidMatchModel(
        dataclasses.replace(before.model.network, queries=7, xfeat="none"),
        dataclasses.replace(before.model.loss, match=3.0),
    )


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
        ({"optimizer": "sgd"}, "optimizer"),
        ({"precision": "fp16"}, "precision"),
    ],
)
def test_values_that_cannot_train_are_refused(changes: dict[str, Any], field: str) -> None:
    with pytest.raises(TrainingError, match=f"recipe field {field} must"):
        dataclasses.replace(RECIPES["cpu"], **changes)


def test_one_cycle_rises_linearly_and_falls_as_half_a_cosine() -> None:
    recipe = dataclasses.replace(RECIPES["cpu"], learning_rate=2.0, schedule="one-cycle", warm_up=0.2)
    at = recipe.learning_rate_at
    assert (at(0.0), at(0.1), at(0.2)) == pytest.approx((0.1, 1.05, 2.0))
    # A cosine is symmetric about its midpoint, where the rate is halfway between the peak and a hundredth of it.
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


def test_recipes_are_plain_json_with_the_kind_of_network() -> None:
    for name in RECIPES:
        for variant in VARIANTS:
            plain = find_recipe(name, variant).to_dict()
            assert json.loads(json.dumps(plain)) == plain
            assert plain["model"]["variant"] == variant
            assert set(plain["model"]) == {"variant", "network", "loss"}


def test_the_cpu_recipe_has_a_quarter_of_the_weights() -> None:
    count = {name: _parameters(name) for name in ("paper", "cpu")}
    assert count["cpu"] < count["paper"] / 4


def _parameters(name: str) -> int:
    return sum(parameter.numel() for parameter in SceneFlowNet(paper_model(name).network).parameters())
