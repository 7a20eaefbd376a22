"""The two networks behind one interface for training: forward pass, losses, and the result for a pair."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any, Protocol

from torch import Tensor, nn

from objectflow.methods.rigidmatch.decoding import output_to_motion, select
from objectflow.methods.sceneflownet.decoding import decode
from objectflow.motion import SceneMotion
from objectflow.networks import SceneFlowNet, SceneFlowNetOutput
from objectflow.networks.kinds import Network
from objectflow.networks.rigidmatch import RigidMatch, RigidMatchOutput
from objectflow.training.model_config import RigidMatchModel, SceneFlowNetModel
from objectflow.training.rigidmatch_losses import rigidmatch_losses
from objectflow.training.sceneflownet_losses import sceneflownet_losses
from objectflow.training.step import Prepared

MapsAndCorrelation = tuple[SceneFlowNetOutput, Tensor | None]
"""The output of `WithCorrelation`."""


class NetworkAdapter(Protocol):
    """A network as the training loop and the validation use it."""

    @property
    def network(self) -> Network:
        """The network without wrappers, whose weights are saved."""
        ...

    @property
    def module(self) -> nn.Module:
        """The module to call on `Prepared.images`; its output holds everything that the losses need."""
        ...

    def losses(self, output: Any, prepared: Prepared) -> dict[str, Tensor]:
        """Every loss term, unweighted and without gradient, and "total", weighted and with gradient."""
        ...

    def to_motion(self, output: Any, prepared: Prepared, index: int) -> SceneMotion:
        """The objects and the scene flow of one pair of the batch."""
        ...

    def header(self) -> dict[str, Any]:
        """What estimators of this network need to find in the header of its weights, beside the size."""
        ...


class WithCorrelation(nn.Module):
    """A `SceneFlowNet` whose output includes the correlation, for the match loss."""

    def __init__(self, network: SceneFlowNet) -> None:
        super().__init__()
        self.network = network

    def forward(self, *images: Tensor) -> MapsAndCorrelation:
        """See `SceneFlowNet.predict`."""
        return self.network.predict(*images)


class SceneFlowNetAdapter:
    """Training of the paper's network."""

    def __init__(self, network: SceneFlowNet, config: SceneFlowNetModel) -> None:
        self.network = network
        self.module = WithCorrelation(network)
        self._config = config

    def losses(self, output: MapsAndCorrelation, prepared: Prepared) -> dict[str, Tensor]:
        """See `NetworkAdapter`."""
        maps, correlation = output
        return sceneflownet_losses(
            maps,
            prepared.targets,
            prepared.points,
            self._config.loss,
            correlation=correlation,
            matches=prepared.matches,
        )

    def to_motion(self, output: MapsAndCorrelation, prepared: Prepared, index: int) -> SceneMotion:
        """See `NetworkAdapter`."""
        maps = SceneFlowNetOutput(*(value[index : index + 1] for value in output[0]))
        return decode(maps, prepared.points[index : index + 1], grouping=self._config.grouping)

    def header(self) -> dict[str, Any]:
        """See `NetworkAdapter`."""
        return {"variant": self._config.method, "grouping": asdict(self._config.grouping)}


class RigidMatchAdapter:
    """Training of `RigidMatch`."""

    def __init__(self, network: RigidMatch, config: RigidMatchModel) -> None:
        self.network = network
        self.module = network
        self._config = config

    def losses(self, output: RigidMatchOutput, prepared: Prepared) -> dict[str, Tensor]:
        """See `NetworkAdapter`."""
        return rigidmatch_losses(output, prepared, self._config.network.stride, self._config.loss)

    def to_motion(self, output: RigidMatchOutput, prepared: Prepared, index: int) -> SceneMotion:
        """See `NetworkAdapter`."""
        return output_to_motion(select(output, index), prepared.points[index : index + 1])

    def header(self) -> dict[str, Any]:
        """See `NetworkAdapter`."""
        return {"variant": self._config.method}
