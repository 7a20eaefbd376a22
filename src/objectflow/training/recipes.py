"""The recipes by name: the paper's, one for a GPU, and one for two CPU cores."""

from __future__ import annotations

import dataclasses

from objectflow.dataset.augment import AugmentSettings
from objectflow.errors import TrainingError
from objectflow.networks import NetworkSettings
from objectflow.training.model_config import VARIANTS, RigidMatchModel, SceneFlowNetModel
from objectflow.training.recipe import Recipe
from objectflow.training.sceneflownet_losses import SceneFlowNetLossSettings

_FAST = dataclasses.replace(
    NetworkSettings(),
    correlation_cosine=True,
    displacement=True,
    displacement_window=1,
    local_motion_window=3,
    length_unit=0.1,
    origin_depth=0.5,
    details=True,
)
"""The paper's widths with every addition to the paper: these learn many times faster."""

_FAST_NARROW = dataclasses.replace(
    _FAST.scaled(0.5),
    trunk_width=16,
    trunk_blocks=(1, 2),
    color_channels=64,
    fine=((32, 32), (24, 24), (16, 16)),
    reach=8,
)
"""Half the widths, fewer still at high resolution; the patch spans 64 of 160 pixels in each direction."""

_FAST_LOSS = SceneFlowNetLossSettings(
    mask=10.0, centrality=4.0, rotation=4.0, translation=60.0, center=100.0, flow=20.0, radius=10.0, match=3.0
)
"""With the paper's weights, the translation's gradient exceeds the mask's for the first thousand steps of a short
run, and all others' for longer: docs/training.md has the numbers."""

_SCENEFLOWNET = {
    "paper": SceneFlowNetModel(),
    "gpu": SceneFlowNetModel(_FAST, _FAST_LOSS),
    "cpu": SceneFlowNetModel(_FAST_NARROW, _FAST_LOSS),
}
_RIGIDMATCH = dict.fromkeys(("paper", "gpu", "cpu"), RigidMatchModel())
"""The size of each network that fits each recipe."""

RECIPES: dict[str, Recipe] = {
    "paper": Recipe(model=_SCENEFLOWNET["paper"], augment=AugmentSettings.nothing()),
    "gpu": Recipe(
        batch_size=48,
        optimizer="adamw",
        learning_rate=4e-4,
        betas=(0.9, 0.99),
        weight_decay=1e-2,
        schedule="one-cycle",
        warm_up=0.05,
        clip=10.0,
        ema_decay=0.999,
        precision="bf16",
        channels_last=True,
        compile=True,
        validate_every=1000,
        validation_pairs=192,
        workers=12,
        model=_SCENEFLOWNET["gpu"],
    ),
    "cpu": Recipe(
        size=(120, 160),
        batch_size=8,
        optimizer="adamw",
        learning_rate=1e-3,
        betas=(0.9, 0.99),
        weight_decay=1e-2,
        schedule="one-cycle",
        warm_up=0.05,
        clip=10.0,
        ema_decay=0.995,
        channels_last=True,
        validate_every=500,
        validation_pairs=64,
        workers=0,
        model=_SCENEFLOWNET["cpu"],
    ),
}
"""Each with the paper's network as c-vl; `find_recipe` gives the other variants."""


def find_recipe(name: str, variant: str = "c-vl") -> Recipe:
    """The recipe of that name, with the network and the losses of that variant.

    Raises:
        TrainingError: an unknown name or variant; the message lists the choices.
    """
    if name not in RECIPES:
        raise TrainingError(f"unknown recipe {name!r}: choose one of {', '.join(RECIPES)}")
    if variant not in VARIANTS:
        raise TrainingError(f"unknown variant {variant!r}: choose one of {', '.join(VARIANTS)}")
    if variant == "rigidmatch":
        return dataclasses.replace(RECIPES[name], model=_RIGIDMATCH[name])
    model = _SCENEFLOWNET[name].with_variant(variant)
    return dataclasses.replace(RECIPES[name], model=model)
