"""Comparison of the two forms of the losses: `python benchmarks/loss_forms.py --data DIR`.

Short runs of the recipe `cpu` that differ only in the pixel-wise errors: L2 norms, as in the paper's text, or squared,
as in the authors' code. All runs start from the same random weights and use the same pairs with the same sensor noise,
which also makes depth missing; the validation has sensor noise too. Prints a table in Markdown, one line per run.
"""

from __future__ import annotations

import dataclasses
import itertools
import time
from collections.abc import Iterator
from pathlib import Path

import torch
import tyro
from rich.console import Console
from torch import nn
from torch.nn.utils import clip_grad_norm_

from objectflow.dataset.augment import AugmentSettings, Inputs, network_inputs
from objectflow.dataset.batches import Batch, Batches
from objectflow.dataset.shards import open_pairs
from objectflow.dataset.targets import Targets, make_targets
from objectflow.networks import SceneFlowNetOutput, scene_flow
from objectflow.training.model_config import SceneFlowNetModel
from objectflow.training.parallel import Process
from objectflow.training.recipes import RECIPES
from objectflow.training.setup import build_adapter, build_optimizer
from objectflow.training.step import prepare, step_generator

FORMS = {"L2": False, "squared": True}
"""Name of each form, and its `SceneFlowNetLossSettings.squared`."""


@dataclasses.dataclass
class Settings:
    """Compares the forms of the losses by short runs."""

    data: Path
    """Folder of the training pairs."""
    val: Path | None = None
    """Folder of the validation pairs; that of the training pairs when None."""
    steps: int = 800
    """Steps of each run."""
    batch_size: int = 8
    """Pairs per step."""
    size: tuple[int, int] = (120, 160)
    """Height and width of images."""
    learning_rate: float = 2e-3
    """Highest learning rate of the recipe's schedule."""
    val_pairs: int = 64
    """Number of validation pairs."""
    seeds: tuple[int, ...] = (0,)
    """Seeds; every form has a run with each."""
    device: str = "cpu"
    """Device to compute on."""


@dataclasses.dataclass
class Score:
    """Means over the pixels of objects that are visible in both frames: cm, and shares 0..1."""

    epe: float
    zero_epe: float
    lost_epe: float
    """End-point error where the sensor lost the depth."""
    in_sphere: float
    """Share of pixels whose trajectory lies within B of the true one, as the grouping needs it."""
    mask_iou: float


def main(settings: Settings) -> None:
    console = Console(soft_wrap=True)
    train = open_pairs(settings.data, "train")
    val = open_pairs(settings.val or settings.data, "val")
    held = list(itertools.islice(Batches(val, 8, size=settings.size, seed=0).one_pass(), settings.val_pairs // 8))
    console.print(
        f"{settings.steps} steps of {settings.batch_size} of {len(train)} pairs at {settings.size[1]}x"
        f"{settings.size[0]}, learning rate {settings.learning_rate:g}, "
        f"{8 * len(held)} validation pairs, torch {torch.__version__}, {settings.device}",
        style="dim",
    )
    console.print("| form | seed | masked EPE, cm | where depth is lost, cm | within B | mask IoU | CPU s |")
    console.print("|---|---|---|---|---|---|---|")
    zero = 0.0
    for seed, (name, squared) in itertools.product(settings.seeds, FORMS.items()):
        batches = Batches(train, settings.batch_size, size=settings.size, seed=seed)
        start = time.process_time()
        network = learn(batches, squared, seed, settings)
        seconds = time.process_time() - start
        score = validate(network, held, settings)
        zero = score.zero_epe
        console.print(
            f"| {name} | {seed} | {score.epe:.2f} | {score.lost_epe:.2f} | {score.in_sphere:.1%} | "
            f"{score.mask_iou:.3f} | {seconds:.0f} |"
        )
    console.print(f"| zero flow | | {zero:.2f} | | | | |")


def learn(batches: Batches, squared: bool, seed: int, settings: Settings) -> nn.Module:
    cpu = RECIPES["cpu"]
    assert isinstance(cpu.model, SceneFlowNetModel)
    recipe = dataclasses.replace(
        cpu,
        seed=seed,
        steps=settings.steps,
        size=settings.size,
        learning_rate=settings.learning_rate,
        model=dataclasses.replace(cpu.model, loss=dataclasses.replace(cpu.model.loss, squared=squared)),
        augment=dataclasses.replace(cpu.augment, depth_sensor=1.0),
    )
    device = torch.device(settings.device)
    adapter = build_adapter(recipe, Process(0, 1, device), backbone=None, start=None)
    optimizer = build_optimizer(recipe, adapter.network, device)
    for step, batch in enumerate(itertools.islice(batches.iterate(), settings.steps)):
        for group in optimizer.param_groups:
            group["lr"] = recipe.learning_rate_at(step / settings.steps)
        prepared = prepare(batch.to(device), recipe, step_generator(seed, step, 0, device))
        loss = adapter.losses(adapter.module(*prepared.images), prepared)["total"]
        optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        clip_grad_norm_(adapter.network.parameters(), recipe.clip or float("inf"))
        optimizer.step()
    return adapter.network


def observe(batch: Batch, generator: torch.Generator) -> tuple[Inputs, Targets]:
    """Inputs and targets of validation pairs, without augmentation but with sensor noise."""
    inputs = network_inputs(batch, AugmentSettings(depth_sensor=1), generator)
    return inputs, make_targets(batch.table, batch.curr_labels, inputs.exact_points)


def outputs(
    network: nn.Module, held: list[Batch], settings: Settings
) -> Iterator[tuple[SceneFlowNetOutput, Inputs, Targets]]:
    network.eval()
    generator = torch.Generator(settings.device).manual_seed(0)
    for batch in held:
        inputs, targets = observe(batch.to(settings.device), generator)
        with torch.no_grad():
            yield network(*inputs[:4]), inputs, targets


def validate(network: nn.Module, held: list[Batch], settings: Settings) -> Score:
    sums = torch.zeros(8, dtype=torch.float64)
    for output, inputs, targets in outputs(network, held, settings):
        flow = scene_flow(output.rotation, output.translation, output.center, inputs.exact_points)
        seen = targets.seen & inputs.exact_points[:, 2].isfinite()
        lost = seen & inputs.curr_points[:, 2].isnan()
        error, motion = (flow - targets.flow).norm(dim=1), targets.flow.norm(dim=1)
        truth = torch.cat([targets.center, targets.center + targets.translation], 1)
        inside = (output.trajectory - truth).norm(dim=1) < targets.radius[:, 0]
        mask = output.mask.argmax(1) > 0
        both, either = mask & targets.mask, mask | targets.mask
        values = (
            error[seen], motion[seen], error[lost], inside[seen].double(), seen.double(), lost.double(), both, either
        )  # fmt: skip
        sums += torch.stack([value.double().sum().cpu() for value in values])
    error_sum, motion_sum, lost_sum, inside_sum, pixels, lost_pixels, both_sum, either_sum = sums.tolist()
    return Score(
        100 * error_sum / pixels,
        100 * motion_sum / pixels,
        100 * lost_sum / max(1, lost_pixels),
        inside_sum / pixels,
        both_sum / max(1, either_sum),
    )


if __name__ == "__main__":
    main(tyro.cli(Settings, description=Settings.__doc__))
