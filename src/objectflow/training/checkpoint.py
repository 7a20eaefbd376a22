"""Checkpoints: everything needed to continue a run exactly, in a folder that appears atomically. No pickle."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import safetensors
import safetensors.torch
import torch
from torch import Tensor

from objectflow.errors import TrainingError
from objectflow.networks.kinds import Network
from objectflow.networks.weights import load_network, save_weights
from objectflow.storage import files
from objectflow.storage.foreign import foreign_errors
from objectflow.storage.serialize import from_plain
from objectflow.training.ema import ExponentialMovingAverage

WEIGHTS, STATE = "weights.safetensors", "state.safetensors"
_KEY = "objectflow"
_PREFIX = "step-"
_AVERAGE, _OPTIMIZER = "mean.", "optimizer."
"""Prefixes of tensors in the state file."""


@dataclass(frozen=True)
class TrainState:
    """The progress of a run.

    Attributes:
        step: number of steps done.
        seconds: training time over all parts of the run.
        best: lowest `Validation.score` so far; None before the first validation.
    """

    step: int = 0
    seconds: float = 0.0
    best: float | None = None


def save_checkpoint(
    root: Path,
    network: Network,
    optimizer: torch.optim.Optimizer,
    average: ExponentialMovingAverage | None,
    state: TrainState,
    *,
    keep: int,
) -> Path:
    """Write `root/step-NNNNNNNN` atomically, then remove all but the last `keep` checkpoints.

    Args:
        root: the run's folder of checkpoints.
        network: without wrappers.
        optimizer: of the network's parameters.
        average: their moving average, if the run keeps one.
        state: the progress of the run.
        keep: number of checkpoints to keep, including this one.

    Raises:
        StorageError: the checkpoint cannot be written.
    """
    path = root / f"{_PREFIX}{state.step:08d}"
    tensors = dict(_optimizer_tensors(network, optimizer))
    if average is not None:
        tensors |= {f"{_AVERAGE}{name}": value for name, value in average.network.state_dict().items()}
    tensors = {name: value.detach().cpu().contiguous() for name, value in tensors.items()}
    header = json.dumps({**asdict(state), "mean_steps": 0 if average is None else average.steps}, sort_keys=True)
    with files.new_folder(path, replace=True) as folder:
        save_weights(folder / WEIGHTS, network, {"step": state.step})
        files.write_bytes(folder / STATE, safetensors.torch.save(tensors, {_KEY: header}))
    remove_old_checkpoints(root, keep)
    return path


def checkpoints(root: Path) -> list[Path]:
    """The checkpoints in a folder, by step."""
    return sorted(path for path in root.glob(f"{_PREFIX}*") if path.is_dir())


def remove_old_checkpoints(root: Path, keep: int) -> None:
    """Remove all but the last `keep` checkpoints of a folder.

    Raises:
        StorageError: one cannot be removed.
    """
    for old in checkpoints(root)[:-keep]:
        files.remove_folder(old)


def load_checkpoint(
    path: Path, network: Network, optimizer: torch.optim.Optimizer, average: ExponentialMovingAverage | None
) -> TrainState:
    """Restore network, optimiser and moving average exactly.

    Raises:
        MethodError: weights of another configuration (the message names the field), or a damaged file.
        TrainingError: a state that does not fit the network or the recipe.
    """
    loaded, _ = load_network(path / WEIGHTS, settings=network.settings)
    network.load_state_dict(loaded.state_dict())
    file = path / STATE
    with foreign_errors(TrainingError, f"{file}: damaged: remove {path} to continue from the checkpoint before it"):
        with safetensors.safe_open(file, framework="pt") as opened:
            header = json.loads((opened.metadata() or {})[_KEY])
            tensors = {name: opened.get_tensor(name) for name in opened.keys()}  # noqa: SIM118 - not a mapping
        mean_steps = int(header.pop("mean_steps"))
        state = from_plain(TrainState, header)
    _fill_optimizer(file, network, optimizer, tensors)
    if average is not None:
        stored = {name[len(_AVERAGE) :]: value for name, value in tensors.items() if name.startswith(_AVERAGE)}
        if stored.keys() != average.network.state_dict().keys():
            raise TrainingError(f"{file}: no moving average of these weights: continue with the run's own recipe")
        average.network.load_state_dict(stored)
        average.steps = mean_steps
    return state


def _optimizer_tensors(network: Network, optimizer: torch.optim.Optimizer) -> Iterator[tuple[str, Tensor]]:
    for name, parameter in network.named_parameters():
        for key, value in optimizer.state.get(parameter, {}).items():
            yield f"{_OPTIMIZER}{name}.{key}", value


def _fill_optimizer(
    file: Path, network: Network, optimizer: torch.optim.Optimizer, tensors: dict[str, Tensor]
) -> None:
    parameters = dict(network.named_parameters())
    optimizer.state.clear()
    for name, value in tensors.items():
        if not name.startswith(_OPTIMIZER):
            continue
        owner, key = name[len(_OPTIMIZER) :].rsplit(".", 1)
        if owner not in parameters:
            raise TrainingError(f"{file}: damaged: {owner} is not a parameter of this network")
        parameter = parameters[owner]
        if value.ndim:
            # The optimiser would have made it in the parameter's own memory layout.
            optimizer.state[parameter][key] = torch.empty_like(parameter, requires_grad=False).copy_(value)
        else:
            # Adam counts its steps on the CPU unless it is fused.
            optimizer.state[parameter][key] = value.to(parameter.device) if optimizer.defaults["fused"] else value
