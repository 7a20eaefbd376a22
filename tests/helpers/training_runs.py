"""Tiny training runs, for tests of everything around the loop. Run as a script, it trains."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from helpers.pair_sets import random_pair, write_pairs
from helpers.small_networks import TINY_RIGID
from objectflow.dataset.augment import AugmentSettings
from objectflow.dataset.manifest import Manifest
from objectflow.networks import NetworkSettings
from objectflow.training.job import TrainJob
from objectflow.training.loop import train
from objectflow.training.model_config import RigidMatchModel, SceneFlowNetModel
from objectflow.training.recipe import Recipe

NETWORK = NetworkSettings(
    trunk_width=8,
    trunk_blocks=(1, 1),
    color_channels=8,
    shape_stages=((4,), (4,), (8,)),
    reach=2,
    down=((8, 8), (8, 8)),
    up=((8, 8),),
    fine=((8, 8), (8, 8), (8, 8)),
)
RECIPE = Recipe(
    size=(24, 32),
    batch_size=4,
    steps=30,
    optimizer="adamw",
    learning_rate=1e-3,
    weight_decay=0.01,
    schedule="one-cycle",
    warm_up=0.1,
    clip=10.0,
    ema_decay=0.9,
    channels_last=True,
    validate_every=20,
    validation_pairs=4,
    log_every=5,
    workers=0,
    augment=AugmentSettings(sensors=1),
    model=SceneFlowNetModel(NETWORK),
)
"""With every feature whose state a resumed run must restore."""
PLAIN = dataclasses.replace(
    RECIPE,
    ema_decay=0.0,
    augment=AugmentSettings.nothing(),
    model=SceneFlowNetModel(dataclasses.replace(NETWORK, trunk_norm="frozen")),
)
"""Without randomness or batch statistics, so that several processes must agree with one."""
RIGID = dataclasses.replace(RECIPE, model=RigidMatchModel(TINY_RIGID))
"""The same for `RigidMatch`."""


def write_set(folder: Path, *, pairs: int = 10) -> Path:
    """A data set whose split val holds the pairs of train."""
    write_pairs(folder, [random_pair(number, objects=1 + number % 3) for number in range(pairs)])
    manifest = Manifest.read(folder)
    part = manifest.parts["train"]
    both = {"train": part, "val": dataclasses.replace(part, split="val")}
    dataclasses.replace(manifest, parts=both).write(folder)
    return folder


def job(data: Path, out: Path, recipe: Recipe = RECIPE, **changes: Any) -> TrainJob:
    """A job on the CPU; `changes` replaces fields."""
    return dataclasses.replace(TrainJob("tiny", recipe, data, out, device="cpu"), **changes)


def checkpoint_tensors(run: Path) -> Mapping[str, torch.Tensor]:
    """Every tensor in a run's last checkpoint, and in its best weights."""
    from safetensors.torch import load_file

    folder = sorted((run / "checkpoints").iterdir())[-1]
    found: dict[str, torch.Tensor] = {"step": torch.tensor(int(folder.name.split("-")[1]))}
    for kind, file in (
        ("last", folder / "weights.safetensors"),
        ("state", folder / "state.safetensors"),
        ("best", run / "weights.safetensors"),
    ):
        found |= {f"{kind} {name}": value for name, value in load_file(file).items()}
    return found


def main(kind: str, data: str, out: str) -> None:
    """Train until killed, or together with the other processes of torchrun's environment."""
    torch.set_num_threads(1)
    if kind == "killed":
        recipe = dataclasses.replace(RECIPE, checkpoint_minutes=0.0, log_every=2, steps=40)
        train(job(Path(data), Path(out), recipe))
    elif kind == "together":
        train(job(Path(data), Path(out), dataclasses.replace(PLAIN, steps=4, validate_every=2, log_every=1)))


if __name__ == "__main__":
    main(*sys.argv[1:])
