"""What differs between the two kinds of network in training: their output, its losses, and what it says of a pair."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from torch import Tensor, nn

from objectflow.methods.rigidmatch.decoding import output_to_motion, select
from objectflow.methods.sceneflownet.decoding import decode
from objectflow.motion import SceneMotion
from objectflow.networks import SceneFlowNet, SceneFlowNetOutput
from objectflow.networks.rigidmatch import RigidMatchOutput
from objectflow.networks.weights import Network
from objectflow.training.recipe import Recipe
from objectflow.training.rigidmatch_losses import rigidmatch_losses
from objectflow.training.sceneflownet_losses import sceneflownet_losses
from objectflow.training.step import Prepared

Output = tuple[SceneFlowNetOutput, Tensor | None] | RigidMatchOutput
"""Of `trained_form`."""


class WithCorrelation(nn.Module):
    """A `SceneFlowNet` as training calls it: maps, and the correlation that the match loss judges."""

    def __init__(self, network: SceneFlowNet) -> None:
        super().__init__()
        self.network = network

    def forward(self, *images: Tensor) -> tuple[SceneFlowNetOutput, Tensor | None]:
        """See `SceneFlowNet.predict`."""
        return self.network.predict(*images)


def trained_form(network: Network) -> nn.Module:
    """The network as training calls it: everything that losses need comes out."""
    return WithCorrelation(network) if isinstance(network, SceneFlowNet) else network


def tensors_of(output: Any) -> Iterator[Tensor]:
    """All tensors with gradient in an output."""
    for one in output:
        if isinstance(one, Tensor):
            if one.requires_grad:
                yield one
        elif one is not None:
            yield from tensors_of(one)


def losses_of(output: Output, prepared: Prepared, recipe: Recipe) -> dict[str, Tensor]:
    """Every term without gradient, unweighted; and "total", weighted, with gradient."""
    if isinstance(output, RigidMatchOutput):
        return rigidmatch_losses(output, prepared, recipe.rigid.stride, recipe.rigid_loss)
    maps, correlation = output
    return sceneflownet_losses(
        maps,
        prepared.targets,
        prepared.points,
        recipe.loss_settings,
        correlation=correlation,
        matches=prepared.matches,
    )


def motion_of(output: Output, prepared: Prepared, recipe: Recipe, index: int) -> SceneMotion:
    """What an output says about one pair of its batch."""
    points = prepared.points[index : index + 1]
    if isinstance(output, RigidMatchOutput):
        return output_to_motion(select(output, index), points)
    maps = SceneFlowNetOutput(*(one[index : index + 1] for one in output[0]))
    return decode(maps, points, grouping=recipe.grouping)
