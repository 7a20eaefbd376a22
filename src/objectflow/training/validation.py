"""Validation: a network's losses, and the metrics of `objectflow evaluate`, on pairs that it is not trained on."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from objectflow.dataset.batches import Batch
from objectflow.evaluation.metrics.flow_metrics import score_flow
from objectflow.evaluation.metrics.segmentation_metrics import score_segmentation
from objectflow.motion import SceneMotion
from objectflow.training.adapters import NetworkAdapter
from objectflow.training.parallel import Process
from objectflow.training.recipe import Recipe
from objectflow.training.setup import precision
from objectflow.training.step import Prepared, prepare
from objectflow.typing import LabelImage


@dataclass(frozen=True)
class Validation:
    """Means over pairs.

    Attributes:
        pairs: number of pairs.
        losses: every term and "total".
        epe_cm: end-point error on objects visible in both frames, with each object's mean motion.
        zero_epe_cm: the same error for zero flow.
        mean_f: mean F-measure of Bideau et al. 2018.
        extracted, true_objects: number of objects found with F >= 0.75, and of all objects.
    """

    pairs: int
    losses: dict[str, float]
    epe_cm: float
    zero_epe_cm: float
    mean_f: float
    extracted: int
    true_objects: int

    @property
    def score(self) -> float:
        """Selection criterion, lower is better: the error relative to zero flow's, minus the mean F-measure.

        Both parts range over about 1. The error alone would select the initial weights, which find nothing, in a run
        that never beats zero flow.
        """
        relative = self.epe_cm / self.zero_epe_cm if self.zero_epe_cm > 0 else 1.0
        return relative - self.mean_f

    def to_dict(self) -> dict[str, Any]:
        """The fields as a line of metrics, with the share of objects extracted."""
        return {**vars(self), "extracted_share": self.extracted / max(1, self.true_objects)}


def validate(adapter: NetworkAdapter, batches: Iterable[Batch], recipe: Recipe, process: Process) -> Validation:
    """Run a network on pairs as they are stored.

    Args:
        adapter: of the network without wrappers, which keeps its mode.
        batches: this process's share; may be empty if there are other processes.
        recipe: of the run.
        process: where to compute; the shares of all processes are averaged together.

    Raises:
        TrainingError, DatasetError: pairs that cannot be read.
    """
    network = adapter.network
    was_training = network.training
    network.eval()
    sums: dict[str, float] = defaultdict(float)
    try:
        with torch.no_grad():
            for batch in batches:
                prepared = prepare(batch.to(process.device), recipe, None)
                with precision(recipe, process.device):
                    output = adapter.module(*prepared.images)
                for name, value in adapter.losses(output, prepared).items():
                    sums[f"loss.{name}"] += float(value) * len(batch)
                for index in range(len(batch)):
                    labels = batch.curr_labels[index].cpu().numpy().astype(np.int32)
                    motion = adapter.to_motion(output, prepared, index)
                    _add(sums, _score(motion, labels, prepared, index))
    finally:
        network.train(was_training)
    return _means(sums, process)


def _score(motion: SceneMotion, labels: LabelImage, prepared: Prepared, index: int) -> dict[str, float]:
    """The metrics of one pair, and the number of pairs that each counts for."""
    measured = torch.isfinite(prepared.points[index]).all(dim=0)
    scale = float(prepared.scale[index])
    flow_map = torch.where(measured, prepared.targets.flow[index] / scale, torch.nan)
    true_flow = flow_map.permute(1, 2, 0).cpu().numpy()
    seen = prepared.targets.seen[index].cpu().numpy()
    flow = score_flow(motion.scene_flow / np.float32(scale), true_flow, seen, seen).masked
    zero = score_flow(np.zeros_like(true_flow), true_flow, seen, seen).masked
    segmentation = score_segmentation(labels, motion.labels)
    numbers = {
        "pairs": 1.0,
        "mean_f": segmentation.mean_f.f,
        "extracted": float(segmentation.extracted),
        "true_objects": float(segmentation.true_objects),
    }
    if flow.predicted:  # without an object visible in both frames there is no masked error
        numbers |= {"with_flow": 1.0, "epe_cm": flow.epe_cm, "zero_epe_cm": zero.epe_cm}
    return numbers


def _means(sums: Mapping[str, float], process: Process) -> Validation:
    """Add the sums of all processes and divide by the number of pairs."""
    total: dict[str, float] = defaultdict(float)
    for share in process.gathered(dict(sums)):
        _add(total, share)
    pairs, with_flow = max(1.0, total["pairs"]), total["with_flow"] or float("nan")
    return Validation(
        pairs=round(total["pairs"]),
        losses={name[5:]: value / pairs for name, value in total.items() if name.startswith("loss.")},
        epe_cm=total["epe_cm"] / with_flow,
        zero_epe_cm=total["zero_epe_cm"] / with_flow,
        mean_f=total["mean_f"] / pairs,
        extracted=round(total["extracted"]),
        true_objects=round(total["true_objects"]),
    )


def _add(sums: dict[str, float], numbers: Mapping[str, float]) -> None:
    for name, value in numbers.items():
        sums[name] += value
