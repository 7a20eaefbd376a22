"""How a network is trained: one typed record a recipe, every field of which may be replaced."""

from __future__ import annotations

import dataclasses
import math
import typing
from dataclasses import dataclass, field
from typing import Any, Literal

from objectflow.dataset.augment import AugmentSettings
from objectflow.errors import TrainingError
from objectflow.methods.sceneflownet.grouping import GroupingSettings
from objectflow.networks import NetworkSettings
from objectflow.networks.rigidmatch import RigidMatchSettings
from objectflow.training.rigidmatch_loss_settings import RigidMatchLossSettings
from objectflow.training.sceneflownet_losses import SceneFlowNetLossSettings

Variant = Literal["s", "c", "c-vl", "rigidmatch"]

FREE = frozenset({"workers", "log_every", "checkpoint_minutes", "keep_checkpoints"})
"""Fields that change no weight: a run may be continued with others."""


@dataclass(frozen=True)
class Recipe:
    """Everything that trained weights depend on, but for the data; the defaults are the paper's.

    Raises:
        TrainingError: a value with which nothing can be trained.
    """

    variant: Variant = "c-vl"
    """s: one encoder, no correlation; c: the paper's network; c-vl: c, trained with variance and violation loss.
    Decides over network.correlation and loss.vl. rigidmatch: the other network, with the fields of rigid and
    rigid-loss instead of network and loss."""
    size: tuple[int, int] = (240, 320)
    """Height and width of training images; stored ones are resized."""
    batch_size: int = 12
    """Pairs a step, over all processes."""
    passes: float = 12.0
    """How often every training pair is used; steps and minutes, where given, replace it."""
    steps: int | None = None
    """How many steps."""
    minutes: float | None = None
    """Stop after so much time spent training, with the learning rate's schedule laid out over it; combined with steps,
    whichever ends first. Runs limited by time are not the same bit for bit."""
    optimizer: Literal["adam", "adamw"] = "adam"
    """AdamW decays weights apart from the gradient."""
    learning_rate: float = 1e-4
    """The highest that the schedule reaches."""
    betas: tuple[float, float] = (0.9, 0.999)
    """Of Adam's running means."""
    weight_decay: float = 0.0
    """Of filters and matrices; biases and normalisation are left alone."""
    schedule: Literal["constant", "one-cycle"] = "constant"
    """one-cycle: up in a line during warm-up, then down half a cosine to a hundredth."""
    warm_up: float = 0.0
    """Share of the run in which the learning rate rises from a twentieth."""
    clip: float | None = None
    """Largest norm of the gradient; a longer one is shortened."""
    ema_decay: float = 0.0
    """Validate and ship a running mean of the weights with this decay a step; 0 takes the weights themselves."""
    precision: Literal["fp32", "bf16"] = "fp32"
    """bf16: the network in bfloat16 where that is safe (autocast); weights, heads and losses stay in float32."""
    channels_last: bool = False
    """Keep images with their channels innermost: faster on CPUs and with bf16."""
    compile: bool = False
    """Compile the network with torch.compile; where that fails, it runs as it is, with a warning."""
    seed: int = 0
    """Of first weights, the order of pairs and augmentation."""
    validate_every: int = 1000
    """Steps between validations; there is one at the end in any case."""
    validation_pairs: int = 200
    """How many pairs of the split val are validated on, the first of it; 0 for none."""
    log_every: int = 10
    """Steps between lines of metrics.jsonl, and between checks of the losses."""
    checkpoint_minutes: float = 10.0
    """Minutes between checkpoints; there is one at the end and at a polite kill in any case."""
    keep_checkpoints: int = 2
    """How many of the last checkpoints stay."""
    workers: int = 2
    """Processes that read data ahead; 0 reads in between steps."""
    network: NetworkSettings = field(default_factory=NetworkSettings)
    loss: SceneFlowNetLossSettings = field(default_factory=SceneFlowNetLossSettings)
    rigid: RigidMatchSettings = field(default_factory=RigidMatchSettings)
    rigid_loss: RigidMatchLossSettings = field(default_factory=RigidMatchLossSettings)
    augment: AugmentSettings = field(default_factory=AugmentSettings)

    def __post_init__(self) -> None:
        for name in ("batch_size", "validate_every", "log_every", "keep_checkpoints"):
            if getattr(self, name) < 1:
                raise TrainingError(f"recipe field {name} must be at least 1, not {getattr(self, name)}")
        for name in ("passes", "learning_rate", "steps", "minutes", "clip"):
            value = getattr(self, name)
            if value is not None and not 0 < value < float("inf"):  # written so that NaN fails too
                raise TrainingError(f"recipe field {name} must be finite and above 0, not {value}")
        for name in ("weight_decay", "checkpoint_minutes", "workers", "validation_pairs"):
            if not 0 <= getattr(self, name) < float("inf"):
                raise TrainingError(f"recipe field {name} must be finite and at least 0, not {getattr(self, name)}")
        for name, values in (("ema_decay", (self.ema_decay,)), ("warm_up", (self.warm_up,)), ("betas", self.betas)):
            if not all(0 <= value < 1 for value in values):
                raise TrainingError(f"recipe field {name} must lie in 0..1, below 1, not {getattr(self, name)}")
        if min(self.size) < 8:
            raise TrainingError(f"recipe field size must be at least 8x8, not {self.size}")
        hints = typing.get_type_hints(type(self))
        for name in ("variant", "optimizer", "schedule", "precision"):
            choices = typing.get_args(hints[name])
            if getattr(self, name) not in choices:
                raise TrainingError(
                    f"recipe field {name} must be one of {', '.join(choices)}, not {getattr(self, name)!r}"
                )

    @property
    def method(self) -> str:
        """The name by which estimators load the weights."""
        return self.variant if self.variant == "rigidmatch" else f"sceneflownet-{self.variant}"

    @property
    def network_settings(self) -> NetworkSettings | RigidMatchSettings:
        """The network of this variant."""
        if self.variant == "rigidmatch":
            return self.rigid
        return dataclasses.replace(self.network, correlation=self.variant != "s")

    @property
    def median_depth(self) -> float:
        """Metres to which each pair's median depth is brought before the network; 0 leaves depth as it is."""
        return self.rigid.median_depth if self.variant == "rigidmatch" else 0.0

    @property
    def loss_settings(self) -> SceneFlowNetLossSettings:
        """The losses of this variant."""
        return dataclasses.replace(self.loss, vl=self.variant == "c-vl")

    @property
    def grouping(self) -> GroupingSettings:
        """How pixels are grouped: by the same trajectory feature as in the losses."""
        return GroupingSettings(rotation_weight=self.loss.rotation_weight)

    def total_steps(self, steps_per_pass: int) -> int | None:
        """How many steps the run has; None where minutes alone limit it."""
        if self.steps is not None:
            return self.steps
        return None if self.minutes is not None else max(1, round(self.passes * steps_per_pass))

    def learning_rate_at(self, progress: float) -> float:
        """The learning rate at a share of the run, 0..1 (one-cycle: Smith 2018, its fall as half a cosine)."""
        return self.learning_rate * _schedule(self.schedule, self.warm_up, progress)

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON, nested as the fields are."""
        plain: dict[str, Any] = _plain(dataclasses.asdict(self))
        return plain


_PEAK_PART, _LAST_PART = 1 / 20, 1 / 100


def _schedule(kind: str, warm_up: float, progress: float) -> float:
    if progress < warm_up:
        return _PEAK_PART + (1 - _PEAK_PART) * progress / warm_up
    if kind == "constant":
        return 1.0
    fall = min(1.0, (progress - warm_up) / (1 - warm_up))
    return _LAST_PART + (1 - _LAST_PART) * 0.5 * (1 + math.cos(math.pi * fall))


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _plain(item) for name, item in value.items()}
    return [_plain(item) for item in value] if isinstance(value, list | tuple) else value


_NARROW = dataclasses.replace(
    NetworkSettings().scaled(0.5),
    trunk_width=16,
    trunk_blocks=(1, 2),
    color_channels=64,
    fine=((32, 32), (24, 24), (16, 16)),
    reach=8,
    correlation_cosine=True,
    displacement=True,
    length_unit=0.1,
    origin_depth=0.5,
    details=True,
)
"""Half the widths, and less where images are large; the patch spans 64 pixels each way, of 160."""

_FAST = SceneFlowNetLossSettings(
    mask=10.0, centrality=4.0, rotation=1.0, translation=60.0, center=100.0, flow=20.0, radius=10.0, match=3.0
)
"""With the paper's weights, T's share of the gradient drowns the mask's for the first thousand steps of a short run,
and all others' for longer: docs/training.md has the numbers."""

RECIPES: dict[str, Recipe] = {
    "paper": Recipe(augment=AugmentSettings.nothing()),
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
        network=dataclasses.replace(
            NetworkSettings(),
            correlation_cosine=True,
            displacement=True,
            length_unit=0.1,
            origin_depth=0.5,
            details=True,
        ),
        loss=_FAST,
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
        network=_NARROW,
        loss=_FAST,
    ),
}
"""By name: the paper's, one for a GPU, one for two CPU cores."""


def find_recipe(name: str) -> Recipe:
    """The recipe of that name.

    Raises:
        TrainingError: there is none; the message lists the choices.
    """
    if name not in RECIPES:
        raise TrainingError(f"unknown recipe {name!r}: choose one of {', '.join(RECIPES)}")
    return RECIPES[name]
