"""A buffer of the losses of several steps, read at once so that a GPU need not be synchronised at every step."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from objectflow.errors import TrainingError
from objectflow.training.parallel import Process

GRADIENT = "gradient"
"""Name under which the gradient's norm is checked and logged."""


class MetricBuffer:
    """Collects the losses of steps until `read` empties it."""

    def __init__(self, process: Process) -> None:
        self._process = process
        self._steps: list[tuple[int, Sequence[str]]] = []
        self._values: list[Tensor] = []
        self._names: list[str] = []

    def add(self, step: int, keys: Sequence[str], losses: Mapping[str, Tensor], gradient: Tensor) -> None:
        """Add a step without synchronising the device.

        Args:
            step: its number.
            keys: of its pairs in this process.
            losses: scalars, with "total" among them.
            gradient: scalar norm of the gradient.
        """
        self._names = [*losses, GRADIENT]
        self._steps.append((step, keys))
        self._values.append(torch.stack([*losses.values(), gradient.to(losses["total"].dtype)]).detach())

    def read(self) -> dict[str, float]:
        """The mean of each value over the steps and all processes.

        Raises:
            TrainingError: a value that is not finite; the message names the step and this process's pairs.
        """
        values = torch.stack(self._values)
        local = values.cpu()
        for (step, keys), row in zip(self._steps, local, strict=True):
            bad = (~row.isfinite()).nonzero()[:, 0].tolist()
            if bad:
                what = ", ".join(f"{self._names[index]} is {float(row[index])}" for index in bad)
                raise TrainingError(
                    f"step {step}: {what}; the pairs were {', '.join(keys)}: lower the learning rate, or look at "
                    "these pairs with `objectflow show`"
                )
        mean = self._process.mean(values.mean(dim=0))
        self._steps, self._values = [], []
        return dict(zip(self._names, mean.tolist(), strict=True))

    def __len__(self) -> int:
        return len(self._steps)
