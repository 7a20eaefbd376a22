"""What a recipe trains: one of the two networks with its own settings and its own loss weights."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from typing import Literal, get_args

from objectflow.errors import TrainingError
from objectflow.methods.sceneflownet.grouping import GroupingSettings
from objectflow.networks import NetworkSettings
from objectflow.networks.rigidmatch import RigidMatchSettings
from objectflow.training.rigidmatch_loss_settings import RigidMatchLossSettings
from objectflow.training.sceneflownet_losses import SceneFlowNetLossSettings

PaperVariant = Literal["s", "c", "c-vl"]
Variant = Literal["s", "c", "c-vl", "rigidmatch"]
VARIANTS: tuple[Variant, ...] = get_args(Variant)
"""The choices of `--variant`."""


@dataclass(frozen=True)
class SceneFlowNetModel:
    """The paper's network and its losses; the defaults are the paper's OurC+vL.

    Raises:
        TrainingError: variance and violation losses for the network without correlation, which the paper does not
            have.
    """

    network: NetworkSettings = field(default_factory=NetworkSettings)
    loss: SceneFlowNetLossSettings = field(default_factory=SceneFlowNetLossSettings)

    def __post_init__(self) -> None:
        if self.loss.vl and not self.network.correlation:
            raise TrainingError(
                "recipe field model.loss.vl must be off where model.network.correlation is: choose --variant s"
            )

    @property
    def variant(self) -> PaperVariant:
        """s: no correlation; c: correlation; c-vl: correlation, trained with variance and violation losses."""
        if not self.network.correlation:
            return "s"
        return "c-vl" if self.loss.vl else "c"

    @property
    def method(self) -> str:
        """The name under which estimators load the weights."""
        return f"sceneflownet-{self.variant}"

    @property
    def rotation_weight(self) -> float:
        """Metres per radian of rotation in the trajectory features of losses, targets and grouping."""
        return self.loss.rotation_weight

    @property
    def median_depth(self) -> float:
        """Zero: the network takes depth as it is."""
        return 0.0

    @property
    def grouping(self) -> GroupingSettings:
        """How pixels are grouped: in the same trajectory space as in the losses."""
        return GroupingSettings(rotation_weight=self.rotation_weight)

    def with_variant(self, variant: PaperVariant) -> SceneFlowNetModel:
        """The same widths and loss weights for another of the paper's variants."""
        return SceneFlowNetModel(
            dataclasses.replace(self.network, correlation=variant != "s"),
            dataclasses.replace(self.loss, vl=variant == "c-vl"),
        )


@dataclass(frozen=True)
class RigidMatchModel:
    """The network `RigidMatch` and its losses; the defaults are the full size."""

    network: RigidMatchSettings = field(default_factory=RigidMatchSettings)
    loss: RigidMatchLossSettings = field(default_factory=RigidMatchLossSettings)

    @property
    def variant(self) -> Literal["rigidmatch"]:
        """The name on the command line."""
        return "rigidmatch"

    @property
    def method(self) -> str:
        """The name under which estimators load the weights."""
        return "rigidmatch"

    @property
    def rotation_weight(self) -> float:
        """Zero: votes have no rotation."""
        return 0.0

    @property
    def median_depth(self) -> float:
        """Metres to which the median depth of each pair is brought; 0 leaves depth as it is."""
        return self.network.median_depth


ModelConfig = SceneFlowNetModel | RigidMatchModel
