"""What a network is worth on pairs that it does not train on: losses, and the metrics of `objectflow evaluate`."""

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
from objectflow.networks.weights import Network
from objectflow.training.adapters import Output, losses_of, motion_of, trained_form
from objectflow.training.parallel import Process
from objectflow.training.recipe import Recipe
from objectflow.training.setup import precision
from objectflow.training.step import Prepared, prepare


@dataclass(frozen=True)
class Validation:
    """Means over pairs.

    Attributes:
        pairs: how many.
        losses: every term and "total".
        epe_cm: end point error on objects that both frames see, with each object's mean motion.
        zero_epe_cm: the same of no motion at all.
        mean_f: Bideau et al. 2018.
        extracted, true_objects: objects found with F >= 0.75, and how many there are.
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
        """What the best weights have least of: the error relative to no motion's, less the mean F.

        Both parts are about 1 wide. The error alone would call the first weights the best, which find nothing, where
        training never beats zero flow.
        """
        relative = self.epe_cm / self.zero_epe_cm if self.zero_epe_cm > 0 else 1.0
        return relative - self.mean_f

    def to_dict(self) -> dict[str, Any]:
        """As a line of metrics, with the share of objects extracted."""
        return {**vars(self), "extracted_share": self.extracted / max(1, self.true_objects)}


def validate(network: Network, batches: Iterable[Batch], recipe: Recipe, process: Process) -> Validation:
    """Run a network over pairs as they are stored.

    Args:
        network: without wrappers; it is left in the mode in which it was.
        batches: this process's share; may be empty where there are others.
        recipe: of the run.
        process: where to compute; all processes' shares are counted together.

    Raises:
        TrainingError, DatasetError: pairs that cannot be read.
    """
    was_training = network.training
    network.eval()
    sums: dict[str, float] = defaultdict(float)
    try:
        with torch.no_grad():
            for batch in batches:
                prepared = prepare(batch.to(process.device), recipe, None)
                with precision(recipe, process.device):
                    output = trained_form(network)(*prepared.images)
                for name, value in losses_of(output, prepared, recipe).items():
                    sums[f"loss.{name}"] += float(value) * len(batch)
                for index in range(len(batch)):
                    _add(sums, _score(output, prepared, batch.curr_labels[index].cpu().numpy(), index, recipe))
    finally:
        network.train(was_training)
    return _means(sums, process)


def _score(
    output: Output, prepared: Prepared, labels: np.ndarray[Any, np.dtype[Any]], index: int, recipe: Recipe
) -> dict[str, float]:
    """One pair's numbers, and how many pairs each counts for."""
    motion = motion_of(output, prepared, recipe, index)
    measured = torch.isfinite(prepared.points[index]).all(dim=0)
    scale = float(prepared.scale[index])
    flow_map = torch.where(measured, prepared.targets.flow[index] / scale, torch.nan)
    true_flow = flow_map.permute(1, 2, 0).cpu().numpy()
    seen = prepared.targets.seen[index].cpu().numpy()
    flow = score_flow(motion.scene_flow / np.float32(scale), true_flow, seen, seen).masked
    still = score_flow(np.zeros_like(true_flow), true_flow, seen, seen).masked
    segmentation = score_segmentation(labels.astype(np.int32), motion.labels)
    numbers = {
        "pairs": 1.0,
        "mean_f": segmentation.mean_f.f,
        "extracted": float(segmentation.extracted),
        "true_objects": float(segmentation.true_objects),
    }
    if flow.predicted:  # a pair without an object that both frames see has no masked error
        numbers |= {"with_flow": 1.0, "epe_cm": flow.epe_cm, "zero_epe_cm": still.epe_cm}
    return numbers


def _means(sums: Mapping[str, float], process: Process) -> Validation:
    """Add up all processes' sums, and divide."""
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
