"""Everything that a run needs to go on as if it had never stopped: one folder, whole or not there. No pickle."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import safetensors
import safetensors.torch
import torch
from torch import Tensor

from objectflow.errors import TrainingError
from objectflow.networks.weights import Network, load_network, save_weights
from objectflow.storage import files
from objectflow.training.ema import ExponentialMovingAverage

WEIGHTS, STATE = "weights.safetensors", "state.safetensors"
_KEY = "objectflow"
_PREFIX = "step-"


@dataclass(frozen=True)
class TrainState:
    """How far a run is.

    Attributes:
        step: steps done.
        seconds: spent training, over all its parts.
        best: the least `Validation.score` so far; None before the first.
    """

    step: int = 0
    seconds: float = 0.0
    best: float | None = None


def save_checkpoint(
    root: Path,
    network: Network,
    optimizer: torch.optim.Optimizer,
    mean: ExponentialMovingAverage | None,
    position: TrainState,
    *,
    keep: int,
) -> Path:
    """Write `root/step-NNNNNNNN` whole or not at all, then remove all but the last `keep`.

    Args:
        root: the run's folder of checkpoints.
        network: without wrappers.
        optimizer: over the network's parameters.
        mean: their running mean, if the run keeps one.
        position: how far the run is.
        keep: how many checkpoints stay, this one among them.

    Raises:
        StorageError: the disk refused.
    """
    path = root / f"{_PREFIX}{position.step:08d}"
    tensors = dict(_optimizer_tensors(network, optimizer))
    if mean is not None:
        tensors |= {f"mean.{name}": value for name, value in mean.network.state_dict().items()}
    tensors = {name: value.detach().cpu().contiguous() for name, value in tensors.items()}
    header = json.dumps({**asdict(position), "mean_steps": 0 if mean is None else mean.steps}, sort_keys=True)
    with files.new_folder(path, replace=True) as folder:
        save_weights(folder / WEIGHTS, network, {"step": position.step})
        files.write_bytes(folder / STATE, safetensors.torch.save(tensors, {_KEY: header}))
    for old in checkpoints(root)[:-keep]:
        # A folder half removed must not look like a checkpoint.
        hidden = old.with_name(f".{old.name}.old")
        os.rename(old, hidden)
        shutil.rmtree(hidden, ignore_errors=True)
    return path


def checkpoints(root: Path) -> list[Path]:
    """The checkpoints in a folder, in order of steps."""
    return sorted(path for path in root.glob(f"{_PREFIX}*") if path.is_dir())


def remove_leftovers(root: Path) -> None:
    """Remove what a killed run left half written or half removed."""
    for path in root.glob(f".{_PREFIX}*"):
        shutil.rmtree(path, ignore_errors=True)


def load_checkpoint(
    path: Path, network: Network, optimizer: torch.optim.Optimizer, mean: ExponentialMovingAverage | None
) -> TrainState:
    """Fill network, optimiser and mean, exactly as they were.

    Raises:
        MethodError: weights of another configuration (the message names the field), or a damaged file.
        TrainingError: a state that does not fit.
    """
    loaded, _ = load_network(path / WEIGHTS, settings=network.settings)
    network.load_state_dict(loaded.state_dict())
    file = path / STATE
    try:
        with safetensors.safe_open(file, framework="pt") as opened:
            header = json.loads((opened.metadata() or {})[_KEY])
            tensors = {name: opened.get_tensor(name) for name in opened.keys()}  # noqa: SIM118 - not a mapping
        mean_steps = int(header.pop("mean_steps"))
        position = TrainState(**header)
    except (OSError, ValueError, KeyError, TypeError, safetensors.SafetensorError) as error:
        raise TrainingError(f"{file}: damaged, remove {path} to go on from the one before: {error}") from error
    _fill_optimizer(file, network, optimizer, tensors)
    if mean is not None:
        stored = {name[5:]: value for name, value in tensors.items() if name.startswith("mean.")}
        if stored.keys() != mean.network.state_dict().keys():
            raise TrainingError(f"{file}: holds no running mean of these weights: continue with the run's own recipe")
        mean.network.load_state_dict(stored)
        mean.steps = mean_steps
    return position


def _optimizer_tensors(network: Network, optimizer: torch.optim.Optimizer) -> Iterator[tuple[str, Tensor]]:
    for name, parameter in network.named_parameters():
        for key, value in optimizer.state.get(parameter, {}).items():
            yield f"optimizer.{name}.{key}", value


def _fill_optimizer(
    file: Path, network: Network, optimizer: torch.optim.Optimizer, tensors: dict[str, Tensor]
) -> None:
    parameters = dict(network.named_parameters())
    optimizer.state.clear()
    for name, value in tensors.items():
        if not name.startswith("optimizer."):
            continue
        owner, key = name[len("optimizer.") :].rsplit(".", 1)
        if owner not in parameters:
            raise TrainingError(f"{file}: damaged: {owner} is no parameter of this network")
        parameter = parameters[owner]
        if value.ndim:
            # In the parameter's own memory layout, as the optimiser would have made it.
            optimizer.state[parameter][key] = torch.empty_like(parameter, requires_grad=False).copy_(value)
        else:
            # Adam counts its steps on the CPU, unless one kernel does all.
            optimizer.state[parameter][key] = value.to(parameter.device) if optimizer.defaults["fused"] else value
