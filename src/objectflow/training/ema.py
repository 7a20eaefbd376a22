"""A running mean of a network's weights: steadier than the last step's, and better on pairs not seen."""

from __future__ import annotations

import copy

import torch

from objectflow.networks.weights import Network


class ExponentialMovingAverage:
    """The exponential mean of a network's parameters and running statistics.

    Attributes:
        network: a copy that holds the mean, in evaluation mode.
        steps: how many updates it has seen.
    """

    def __init__(self, network: Network, decay: float) -> None:
        """Start from the network as it is.

        Args:
            network: without wrappers; its tensors are followed, so they must only be changed in place from here on.
            decay: what is left of the mean in a step, 0..1. Early on it is less, or first weights would linger.
        """
        self.network = copy.deepcopy(network).requires_grad_(False).eval()
        self.decay, self.steps = decay, 0
        # Found once: walking through the modules would cost as much as the update.
        self._pairs = list(zip(self.network.state_dict().values(), network.state_dict().values(), strict=True))

    @torch.no_grad()
    def update(self) -> None:
        """Move the mean towards the network's present weights."""
        self.steps += 1
        part = 1 - min(self.decay, self.steps / (self.steps + 9))
        for mean, now in self._pairs:
            if mean.is_floating_point():
                mean.lerp_(now, part)
            else:
                mean.copy_(now)
