"""A training job: what to train on which data, the batches that follow from it, and the settings that identify it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from objectflow import __version__
from objectflow.dataset.batches import Batches
from objectflow.dataset.concatenated import open_joined
from objectflow.dataset.manifest import Manifest, hash_part
from objectflow.dataset.shards import open_pairs
from objectflow.errors import TrainingError
from objectflow.storage.files import hash_file
from objectflow.training.parallel import Process
from objectflow.training.recipe import Recipe


@dataclass(frozen=True)
class TrainJob:
    """A request to train.

    Attributes:
        name: the recipe's, for the record.
        recipe: how to train.
        data: folder of a data set with the split train, and val for validation.
        out: the run's folder.
        extra_data: more data sets, whose pairs of the split train are mixed in with equal weight.
        resume: continue from the last checkpoint in `out`, if there is one.
        device: "auto", "cpu", "cuda" or "cuda:N".
        backbone: torchvision's `resnet50` state dict to initialise the colour trunk.
        start: weights of an earlier run to start from.
        validate_on: the split; "train" measures how well the training pairs are memorised.
    """

    name: str
    recipe: Recipe
    data: Path
    out: Path
    extra_data: tuple[Path, ...] = ()
    resume: bool = False
    device: str = "auto"
    backbone: Path | None = None
    start: Path | None = None
    validate_on: str = "val"


def open_data(job: TrainJob, process: Process, manifest: Manifest) -> tuple[Batches, Batches | None]:
    """The batches of this process for training and for validation; None without validation.

    Args:
        job: the data and the recipe.
        process: its rank and the number of processes.
        manifest: of `job.data`.

    Raises:
        TrainingError: a batch size that is not a multiple of the number of processes.
        DatasetError: no split train, a wrong hash, or no objects.
    """
    recipe = job.recipe
    if recipe.batch_size % process.world_size:
        raise TrainingError(
            f"a batch of {recipe.batch_size} pairs cannot be shared by {process.world_size} processes: "
            "choose a multiple for --batch-size"
        )
    share = recipe.batch_size // process.world_size
    common: dict[str, Any] = {"size": recipe.size, "rank": process.rank, "world_size": process.world_size}
    pairs = open_joined((job.data, *job.extra_data), "train")
    train = Batches(pairs, share, seed=recipe.seed, workers=recipe.workers, **common)
    if recipe.validation_pairs == 0 or job.validate_on not in manifest.parts:
        return train, None
    return train, Batches(open_pairs(job.data, job.validate_on), share, seed=0, shuffle=False, **common)


def run_settings(job: TrainJob, process: Process, manifest: Manifest, others: Sequence[Manifest]) -> dict[str, Any]:
    """Everything that the weights depend on, as plain JSON.

    Args:
        job: the request.
        process: the number of processes.
        manifest: of `job.data`.
        others: of `job.extra_data`.
    """
    hashes: dict[str, Any] = {
        name: hash_part(part) for name, part in manifest.parts.items() if name in ("train", job.validate_on)
    }
    if others:
        hashes["extra_data"] = [hash_part(other.parts["train"]) for other in others]
    return {
        "recipe_name": job.name,
        "recipe": job.recipe.to_dict(),
        "data": hashes,
        "backbone": None if job.backbone is None else hash_file(job.backbone),
        "start": None if job.start is None else hash_file(job.start),
        "processes": process.world_size,
        "version": __version__,
    }
