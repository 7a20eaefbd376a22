"""A recipe: everything that trained weights depend on except the data, as one typed record."""

from __future__ import annotations

import math
import typing
from dataclasses import dataclass, field
from typing import Any, Literal

from objectflow.dataset.augment import AugmentSettings
from objectflow.errors import TrainingError
from objectflow.storage.serialize import to_plain
from objectflow.training.model_config import ModelConfig, SceneFlowNetModel

FREE = frozenset({"workers", "log_every", "checkpoint_minutes", "keep_checkpoints"})
"""Fields that change no weight: a run may be continued with other values."""

_START_SHARE, _END_SHARE = 1 / 20, 1 / 100
"""Learning rates at the start of the warm-up and at the end of one-cycle, relative to the highest."""


@dataclass(frozen=True)
class Recipe:
    """How a network is trained; the defaults are the paper's.

    Raises:
        TrainingError: a value with which nothing can be trained.
    """

    size: tuple[int, int] = (240, 320)
    """Height and width of training images; stored ones are resized."""
    batch_size: int = 12
    """Pairs per step, over all processes."""
    passes: float = 12.0
    """Number of passes over the training pairs; replaced by steps and minutes where these are given."""
    steps: int | None = None
    """Number of steps."""
    minutes: float | None = None
    """Stop after this much training time; the learning-rate schedule then spans this time. With steps as well,
    whichever ends first. Runs limited by time are not bit-for-bit reproducible."""
    optimizer: Literal["adam", "adamw"] = "adam"
    """AdamW decays weights separately from the gradient."""
    learning_rate: float = 1e-4
    """Highest value of the schedule."""
    betas: tuple[float, float] = (0.9, 0.999)
    """Decay rates of Adam's running means."""
    weight_decay: float = 0.0
    """Weight decay of filters and matrices; biases and normalisation have none."""
    schedule: Literal["constant", "one-cycle"] = "constant"
    """one-cycle: linear warm-up, then half a cosine down to a hundredth."""
    warm_up: float = 0.0
    """Share of the run in which the learning rate rises from a twentieth, 0..1."""
    clip: float | None = None
    """Maximum norm of the gradient; longer gradients are scaled down."""
    ema_decay: float = 0.0
    """Decay per step of the moving average of the weights that is validated and shipped; 0: no average."""
    precision: Literal["fp32", "bf16"] = "fp32"
    """bf16: autocast to bfloat16 in the network; weights, heads and losses stay in float32."""
    channels_last: bool = False
    """Store images with their channels innermost: faster on CPUs and with bf16."""
    compile: bool = False
    """Compile the network with torch.compile; if that fails, it runs uncompiled, with a warning."""
    seed: int = 0
    """Seed of the initial weights, the order of pairs and the augmentation."""
    validate_every: int = 1000
    """Steps between validations; the last step always has one."""
    validation_pairs: int = 200
    """Number of pairs of the split val to validate on, from its start; 0 for none."""
    log_every: int = 10
    """Steps between lines of metrics.jsonl, and between checks of the losses."""
    checkpoint_minutes: float = 10.0
    """Minutes between checkpoints; one is always written at the end and after Ctrl-C or SIGTERM."""
    keep_checkpoints: int = 2
    """Number of checkpoints to keep."""
    workers: int = 2
    """Processes that read data ahead; 0 reads between steps."""
    model: ModelConfig = field(default_factory=SceneFlowNetModel)
    """The network and its losses; --variant chooses between the two kinds."""
    augment: AugmentSettings = field(default_factory=AugmentSettings)

    def __post_init__(self) -> None:
        for name in ("batch_size", "validate_every", "log_every", "keep_checkpoints"):
            if getattr(self, name) < 1:
                raise TrainingError(f"recipe field {name} must be at least 1, not {getattr(self, name)}")
        for name in ("passes", "learning_rate", "steps", "minutes", "clip"):
            value = getattr(self, name)
            if value is not None and not 0 < value < float("inf"):  # NaN fails this comparison too
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
        for name in ("optimizer", "schedule", "precision"):
            choices = typing.get_args(hints[name])
            if getattr(self, name) not in choices:
                raise TrainingError(
                    f"recipe field {name} must be one of {', '.join(choices)}, not {getattr(self, name)!r}"
                )

    def total_steps(self, steps_per_pass: int) -> int | None:
        """Number of steps of the run; None if only minutes limit it."""
        if self.steps is not None:
            return self.steps
        return None if self.minutes is not None else max(1, round(self.passes * steps_per_pass))

    def learning_rate_at(self, progress: float) -> float:
        """The learning rate at a share of the run, 0..1 (one-cycle: Smith 2018, with half a cosine as its descent)."""
        return self.learning_rate * _schedule(self.schedule, self.warm_up, progress)

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON, nested as the fields are; `model` also holds its `variant`."""
        plain: dict[str, Any] = to_plain(self)
        plain["model"]["variant"] = self.model.variant
        return plain


def _schedule(kind: str, warm_up: float, progress: float) -> float:
    if progress < warm_up:
        return _START_SHARE + (1 - _START_SHARE) * progress / warm_up
    if kind == "constant":
        return 1.0
    descent = min(1.0, (progress - warm_up) / (1 - warm_up))
    return _END_SHARE + (1 - _END_SHARE) * 0.5 * (1 + math.cos(math.pi * descent))
