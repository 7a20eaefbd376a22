"""Which form of the losses, and of telling of missing depth, learns better: `benchmarks/loss_forms.py --data DIR`.

Short runs of a narrow network that differ in one thing: the pixel-wise differences as L2-norms or squared (the paper's
text says the one, its code does the other), and missing depth as a validity channel or left out by masked
convolutions. Each starts from the same random weights and sees the same pairs, with the same sensor noise, which is
what makes depth missing; so does the validation. Prints a table in Markdown, one line a run.
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

from objectflow.dataset.augment import AugmentSettings, Inputs, augment, network_inputs
from objectflow.dataset.batches import Batch, Batches
from objectflow.dataset.shards import open_pairs
from objectflow.dataset.targets import Targets, make_targets
from objectflow.networks import DenseMotion, NetworkSettings, SceneFlowNet, scene_flow
from objectflow.training.losses import LossSettings, compute_losses

FORMS = {"L2, channel": (False, "channel"), "squared, channel": (True, "channel"), "L2, masked": (False, "masked")}


@dataclasses.dataclass
class Settings:
    """Compares forms of the losses and of missing depth by short runs."""

    data: Path
    """Folder of the training pairs."""
    val: Path | None = None
    """Folder of the validation pairs; that of the training pairs when None."""
    steps: int = 300
    """Steps of each run."""
    batch_size: int = 8
    """Pairs a step."""
    size: tuple[int, int] = (120, 160)
    """Height and width."""
    width: float = 0.125
    """Of the paper's network."""
    learning_rate: float = 1e-3
    """Of Adam, falling along half a cosine."""
    val_pairs: int = 64
    """Pairs validated on."""
    seeds: tuple[int, ...] = (0,)
    """One run each, of every form."""
    device: str = "cpu"
    """Where to compute."""


@dataclasses.dataclass
class Score:
    """Means over the pixels of objects that both frames see: centimetres, and shares."""

    epe: float
    zero_epe: float
    lost_epe: float
    """Where the sensor lost the depth."""
    in_sphere: float
    """Pixels whose trajectory lies within B of the truth's: what grouping needs."""
    mask_iou: float


def main(settings: Settings) -> None:
    console = Console(soft_wrap=True)
    train = open_pairs(settings.data, "train")
    val = open_pairs(settings.val or settings.data, "val")
    held = list(itertools.islice(Batches(val, 8, size=settings.size, seed=0).one_pass(), settings.val_pairs // 8))
    console.print(
        f"{settings.steps} steps of {settings.batch_size} of {len(train)} pairs at {settings.size[1]}x"
        f"{settings.size[0]}, {settings.width:g} of the paper's width, Adam {settings.learning_rate:g}, "
        f"{8 * len(held)} validation pairs, torch {torch.__version__}, {settings.device}",
        style="dim",
    )
    console.print("| form | seed | masked EPE, cm | where depth is lost, cm | within B | mask IoU | CPU s |")
    console.print("|---|---|---|---|---|---|---|")
    zero = 0.0
    for seed, (name, (squared, missing)) in itertools.product(settings.seeds, FORMS.items()):
        batches = Batches(train, settings.batch_size, size=settings.size, seed=seed)
        start = time.process_time()
        network = learn(batches, squared, missing, seed, settings)
        seconds = time.process_time() - start
        score = validate(network, held, settings)
        zero = score.zero_epe
        console.print(
            f"| {name} | {seed} | {score.epe:.2f} | {score.lost_epe:.2f} | {score.in_sphere:.1%} | "
            f"{score.mask_iou:.3f} | {seconds:.0f} |"
        )
    console.print(f"| zero flow | | {zero:.2f} | | | | |")


def learn(batches: Batches, squared: bool, missing: str, seed: int, settings: Settings) -> SceneFlowNet:
    network_settings = dataclasses.replace(NetworkSettings().scaled(settings.width), missing=missing)
    network = SceneFlowNet(network_settings, generator=torch.Generator().manual_seed(seed)).to(settings.device)
    optimizer = torch.optim.Adam(network.parameters(), settings.learning_rate)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, settings.steps)
    generator = torch.Generator(settings.device).manual_seed(seed)
    loss_settings = LossSettings(squared=squared)
    for batch in itertools.islice(batches.iterate(), settings.steps):
        varied = augment(batch.to(settings.device), AugmentSettings(), generator)
        inputs, targets = prepare(varied, generator)
        loss = compute_losses(network(*inputs[:4]), targets, inputs.exact_points, loss_settings)["total"]
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    return network


def prepare(batch: Batch, generator: torch.Generator) -> tuple[Inputs, Targets]:
    inputs = network_inputs(batch, AugmentSettings(depth_sensor=1), generator)
    return inputs, make_targets(batch.table, batch.curr_labels, inputs.exact_points)


def outputs(
    network: SceneFlowNet, held: list[Batch], settings: Settings
) -> Iterator[tuple[DenseMotion, Inputs, Targets]]:
    network.eval()
    generator = torch.Generator(settings.device).manual_seed(0)
    for batch in held:
        inputs, targets = prepare(batch.to(settings.device), generator)
        with torch.no_grad():
            yield network(*inputs[:4]), inputs, targets


def validate(network: SceneFlowNet, held: list[Batch], settings: Settings) -> Score:
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
