"""An exponential moving average of a network's weights, which generalises better than the last step's weights.

`torch.optim.swa_utils.AveragedModel` is not used because it does another average: its first update copies the weights,
its decay is constant from then on, and with `use_buffers` it rounds averaged integer buffers (`num_batches_tracked`).
"""

from __future__ import annotations

import copy

import torch

from objectflow.networks.kinds import Network
from objectflow.training.adapters import NetworkAdapter


class ExponentialMovingAverage:
    """The exponential moving average of a network's parameters and running statistics.

    Attributes:
        adapter: a copy of the adapter whose network holds the average, in evaluation mode.
        steps: number of updates so far.
    """

    def __init__(self, adapter: NetworkAdapter, decay: float) -> None:
        """Start from the network's present weights.

        Args:
            adapter: of the network to follow; its tensors may only change in place from here on.
            decay: share of the average that one step keeps, 0..1. Early steps keep less, so that the initial weights
                fade quickly.
        """
        self.adapter = copy.deepcopy(adapter)
        self.adapter.network.requires_grad_(False).eval()
        self.decay, self.steps = decay, 0
        # The tensors are paired once, because walking through the modules costs as much as the update.
        averages, values = self.network.state_dict().values(), adapter.network.state_dict().values()
        self._pairs = list(zip(averages, values, strict=True))

    @property
    def network(self) -> Network:
        """The network that holds the average."""
        return self.adapter.network

    @torch.no_grad()
    def update(self) -> None:
        """Move the average towards the network's present weights."""
        self.steps += 1
        weight = 1 - min(self.decay, self.steps / (self.steps + 9))
        for average, value in self._pairs:
            if average.is_floating_point():
                average.lerp_(value, weight)
            else:
                average.copy_(value)
