"""How many objects the queries of `rigidmatch` reach: `python benchmarks/queries.py --data data --split val`.

Prints, for numbers of queries and radii of seeds, the mean F-measure and the extracted objects of the network, without
the steps after it, with queries on one object merged and not merged, and the CPU seconds of the network per pair. No
tensor depends on either setting, so all rows have the same weights.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import tyro

from objectflow.evaluation.data.sources import PairSet, open_set
from objectflow.evaluation.metrics.segmentation_metrics import score_segmentation
from objectflow.geometry.resample import nearest_indices
from objectflow.methods.network_io import scaled_size
from objectflow.methods.rigidmatch.decoding import DUPLICATE_IOU, decode
from objectflow.methods.rigidmatch.estimator import RigidMatchEstimator


@dataclass
class Settings:
    """Objects found by numbers of queries and radii of seeds."""

    data: Path
    """Folder of a generated set."""
    split: str = "val"
    """Its split."""
    limit: int = 32
    """Largest number of pairs."""
    weights: Path | None = None
    """A file or folder of weights; the released ones by default."""
    queries: tuple[int, ...] = (48, 96, 128, 160)
    """Numbers of queries."""
    radii: tuple[float, ...] = (0.06, 0.1)
    """Radii of seeds in metres."""


@dataclass
class Found:
    """Sums over pairs."""

    f: float = 0.0
    extracted: int = 0
    true: int = 0


def main(settings: Settings) -> None:
    torch.set_num_threads(1)
    pairs = open_set(str(settings.data), split=settings.split)
    keys = pairs.keys[: settings.limit]
    print(f"{len(keys)} pairs of {settings.data.name}; queries are merged from an overlap of {DUPLICATE_IOU}\n")
    print("| queries | radius, m | mean F | extracted | merged: mean F | extracted | network, CPU s |")
    print("|---|---|---|---|---|---|---|")
    for radius in settings.radii:
        for queries in settings.queries:
            estimator = RigidMatchEstimator(weights=settings.weights, queries=queries, seed_radius=radius)
            apart, merged, seconds = score(estimator, pairs, keys)
            print(
                f"| {queries} | {radius} | {apart.f / len(keys):.3f} | {apart.extracted}/{apart.true} "
                f"| {merged.f / len(keys):.3f} | {merged.extracted}/{merged.true} | {seconds:.2f} |"
            )


def score(estimator: RigidMatchEstimator, pairs: PairSet, keys: Sequence[str]) -> tuple[Found, Found, float]:
    """Objects found with every query apart and with queries on one object merged, and the network's median time."""
    found, seconds = (Found(), Found()), []
    for key in keys:
        pair = pairs.pair(key)
        height, width = size = scaled_size(pair.curr, estimator.size)
        frames = [frame.resized(width, height) for frame in (pair.prev, pair.curr)]
        start = time.process_time()
        output, _ = estimator.predict(frames[:1], frames[1:])
        seconds.append(time.process_time() - start)
        rows, columns = nearest_indices(size, pair.truth.labels.shape)
        for sums, iou in zip(found, (1.0, DUPLICATE_IOU), strict=True):
            labels, _ = decode(output, size, duplicate_iou=iou)
            result = score_segmentation(pair.truth.labels, labels[rows[:, None], columns])
            sums.f += result.mean_f.f
            sums.extracted += result.extracted
            sums.true += result.true_objects
    return *found, float(np.median(seconds))


if __name__ == "__main__":
    main(tyro.cli(Settings))
