"""What a run trains with: the network in its adapter, its compiled form, and the optimiser."""

from __future__ import annotations

import contextlib
import copy
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from objectflow.errors import MethodError
from objectflow.networks import SceneFlowNet
from objectflow.networks.kinds import Network
from objectflow.networks.rigidmatch import RigidMatch
from objectflow.networks.sceneflownet.correlation import exclude_from_compilation
from objectflow.networks.weights import load_network
from objectflow.training.adapters import NetworkAdapter, RigidMatchAdapter, SceneFlowNetAdapter
from objectflow.training.model_config import RigidMatchModel, SceneFlowNetModel
from objectflow.training.parallel import Process, synchronize_batch_norm
from objectflow.training.recipe import Recipe

NEEDS_XFEAT = (
    "this network needs the filters of XFeat: give a file of scripts/convert_xfeat.py by --backbone-weights, weights "
    "to start from by --start-from, or {}"
)


def build_adapter(recipe: Recipe, process: Process, *, backbone: Path | None, start: Path | None) -> NetworkAdapter:
    """The network with its initial weights, the same in every process, on its device, in training mode.

    Args:
        recipe: its model and the seed of its random weights.
        process: this process, with its device.
        backbone: XFeat's filters for a network with `xfeat`, else torchvision's `resnet50` state dict for the colour
            trunk of the paper's network.
        start: weights of an earlier run to start from.

    Raises:
        MethodError: a file that does not fit; the message names the field or the tensor.
    """
    generator = torch.Generator().manual_seed(recipe.seed)
    network: Network
    adapter: NetworkAdapter
    match recipe.model:
        case SceneFlowNetModel() as paper:
            if start is None and backbone is None and paper.network.correlation and paper.network.xfeat:
                raise MethodError(NEEDS_XFEAT.format("--model.network.no-xfeat"))
            if start is None:
                network = SceneFlowNet(paper.network, generator=generator)
            else:
                network, _ = load_network(start, settings=paper.network)
            adapter = SceneFlowNetAdapter(network, paper)
            has_batch_norm = paper.network.trunk_norm == "batch"
        case RigidMatchModel() as rigid:
            if start is None and backbone is None and rigid.network.xfeat != "none":
                raise MethodError(NEEDS_XFEAT.format("--model.network.xfeat none"))
            if start is None:
                network = RigidMatch(rigid.network, generator=generator)
            else:
                network, _ = load_network(start, settings=rigid.network)
            adapter = RigidMatchAdapter(network, rigid)
            has_batch_norm = True
    if backbone is not None:
        network.load_backbone(backbone)
    network.to(process.device).train()
    if recipe.channels_last:
        network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    if has_batch_norm:
        synchronize_batch_norm(network, process)
    return adapter


def build_optimizer(recipe: Recipe, network: nn.Module, device: torch.device) -> torch.optim.Optimizer:
    """Adam or AdamW, fused on CUDA; biases and normalisation, which are vectors, have no weight decay."""
    kinds: dict[str, Any] = {"adam": torch.optim.Adam, "adamw": torch.optim.AdamW}
    matrices = [parameter for parameter in network.parameters() if parameter.ndim > 1]
    vectors = [parameter for parameter in network.parameters() if parameter.ndim <= 1]
    groups = [
        {"params": matrices, "weight_decay": recipe.weight_decay},
        {"params": vectors, "weight_decay": 0.0},
    ]
    out: torch.optim.Optimizer = kinds[recipe.optimizer](
        groups, lr=recipe.learning_rate, betas=recipe.betas, fused=device.type == "cuda"
    )
    return out


def precision(recipe: Recipe, device: torch.device) -> contextlib.AbstractContextManager[Any]:
    """The context in which the network computes: autocast to bfloat16, or nothing."""
    if recipe.precision == "bf16":
        return torch.autocast(device.type, torch.bfloat16)
    return contextlib.nullcontext()


def compiled(
    module: nn.Module, recipe: Recipe, images: tuple[Tensor, ...], device: torch.device, note: Callable[[str], None]
) -> nn.Module:
    """The module compiled and tried forward and backward; the module itself if that fails.

    Args:
        module: as training calls it; its weights, running statistics and gradients do not change.
        recipe: whether to compile, and with what precision.
        images: the module's arguments, of the sizes used in training.
        device: the device of both.
        note: receives one line with the reason if compilation fails.
    """
    if not recipe.compile:
        return module
    before = copy.deepcopy(module.state_dict())
    out: Any = module
    try:
        exclude_from_compilation()
        candidate = torch.compile(module)
        with precision(recipe, device):
            output = candidate(*images)
        squares = [tensor.float().square().mean() for tensor in tensors_of(output)]
        torch.stack(squares).sum().backward()  # type: ignore[no-untyped-call]
        out = candidate
    except Exception as error:
        reason = (str(error).splitlines() or [""])[0]
        note(f"torch.compile failed, running uncompiled: {type(error).__name__}: {reason}")
    module.zero_grad(set_to_none=True)
    module.load_state_dict(before)
    return out  # type: ignore[no-any-return]


def tensors_of(output: Any) -> Iterator[Tensor]:
    """All tensors with gradient in a network's output, however nested."""
    for value in output:
        if isinstance(value, Tensor):
            if value.requires_grad:
                yield value
        elif value is not None:
            yield from tensors_of(value)
