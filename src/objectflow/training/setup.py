"""What a run trains with: the network, its compiled form, the optimiser."""

from __future__ import annotations

import contextlib
import copy
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from objectflow.errors import MethodError
from objectflow.networks import SceneFlowNet
from objectflow.networks.rigidmatch import RigidMatch, RigidMatchSettings
from objectflow.networks.sceneflownet.settings import NetworkSettings
from objectflow.networks.weights import Network, load_network
from objectflow.training.adapters import tensors_of
from objectflow.training.parallel import Process, normalised_together
from objectflow.training.recipe import Recipe


def build_network(recipe: Recipe, process: Process, *, backbone: Path | None, start: Path | None) -> Network:
    """The network with first weights, the same in every process, on its device.

    Args:
        recipe: its settings and the seed of its random weights.
        process: where it goes.
        backbone: torchvision's `resnet50` state dict for the colour trunk, or XFeat's filters for rigidmatch.
        start: weights of an earlier run to begin with.

    Raises:
        MethodError: a file that does not fit; the message names the field or the tensor.
    """
    settings = recipe.network_settings
    generator = torch.Generator().manual_seed(recipe.seed)
    network: Network
    if start is not None:
        network, _ = load_network(start, settings=settings)
    elif isinstance(settings, NetworkSettings):
        network = SceneFlowNet(settings, generator=generator)
    else:
        network = RigidMatch(settings, generator=generator)
    if backbone is not None:
        network.load_backbone(backbone)
    elif start is None and isinstance(settings, RigidMatchSettings) and settings.xfeat != "none":
        raise MethodError(
            "rigidmatch needs XFeat's filters: give a file of scripts/convert_xfeat.py by --backbone-weights, "
            "weights to start from by --start-from, or --rigid.xfeat none"
        )
    network.to(process.device).train()
    if recipe.channels_last:
        network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    if not isinstance(settings, NetworkSettings) or settings.trunk_norm == "batch":
        normalised_together(network, process)
    return network


def build_optimizer(recipe: Recipe, network: nn.Module, device: torch.device) -> torch.optim.Optimizer:
    """Adam or AdamW; biases and normalisation, being vectors, are not decayed. One kernel for all on CUDA."""
    kinds: dict[str, Any] = {"adam": torch.optim.Adam, "adamw": torch.optim.AdamW}
    matrices = [one for one in network.parameters() if one.ndim > 1]
    vectors = [one for one in network.parameters() if one.ndim <= 1]
    groups = [
        {"params": matrices, "weight_decay": recipe.weight_decay},
        {"params": vectors, "weight_decay": 0.0},
    ]
    out: torch.optim.Optimizer = kinds[recipe.optimizer](
        groups, lr=recipe.learning_rate, betas=recipe.betas, fused=device.type == "cuda"
    )
    return out


def precision(recipe: Recipe, device: torch.device) -> contextlib.AbstractContextManager[Any]:
    """The numbers that the network computes with."""
    if recipe.precision == "bf16":
        return torch.autocast(device.type, torch.bfloat16)
    return contextlib.nullcontext()


def compiled(
    network: nn.Module, recipe: Recipe, images: tuple[Tensor, ...], device: torch.device, note: Callable[[str], None]
) -> nn.Module:
    """The network compiled and tried forward and backward, or as it is where that fails.

    Args:
        network: as training calls it; its weights, running statistics and gradients are left as they were.
        recipe: whether, and with what precision.
        images: the network's arguments, of the sizes that training has.
        device: theirs.
        note: told in one line why the network runs uncompiled.
    """
    if not recipe.compile:
        return network
    before = copy.deepcopy(network.state_dict())
    out: Any = network
    try:
        candidate = torch.compile(network)
        with precision(recipe, device):
            output = candidate(*images)
        torch.stack([one.float().square().mean() for one in tensors_of(output)]).sum().backward()  # type: ignore[no-untyped-call]
        out = candidate
    except Exception as error:
        reason = (str(error).splitlines() or [""])[0]
        note(f"torch.compile failed, going on without: {type(error).__name__}: {reason}")
    network.zero_grad(set_to_none=True)
    network.load_state_dict(before)
    return out  # type: ignore[no-any-return]
