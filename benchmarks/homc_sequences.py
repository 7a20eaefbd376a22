"""HOMC on generated sequences, sparse and dense: `python benchmarks/homc_sequences.py --data DIR --split val`.

Frame 80 of each sequence is segmented using all eight frames. Sparse labels are scored on the tracked pixels, whose
share is printed; dense labels are scored everywhere. Each value of `--join` (t0) has two rows; its default was chosen
by this benchmark on a validation split.
"""

from __future__ import annotations

import dataclasses
import itertools
import time
from pathlib import Path

import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

from objectflow.dataset.schema import SequenceRow
from objectflow.dataset.shards import open_sequences
from objectflow.evaluation.metrics.segmentation_metrics import SegmentationScore, score_segmentation
from objectflow.methods.baselines.homc.densify import densify
from objectflow.methods.baselines.homc.estimator import Homc, Segmentation, lab_image, pixel_index
from objectflow.typing import LabelImage, UInt8Array

PREV_FRAME, CURR_FRAME = 20, 80


@dataclasses.dataclass
class Settings:
    """Scores HOMC on sequences."""

    data: Path
    """Folder of a generated data set with sequences."""
    split: str = "val"
    """Split of the data set."""
    limit: int = 30
    """Maximum number of sequences."""
    join: tuple[float, ...] = (Homc.join,)
    """Values of t0."""
    pair: bool = False
    """Use only frames 20 and 80, repeated five times."""


def main(settings: Settings) -> None:
    rows = open_sequences(settings.data, settings.split)
    ordered = (rows[k] for k in range(len(rows)))
    groups = itertools.groupby(ordered, key=lambda row: row.sequence)
    sequences = [list(group) for _, group in groups][: settings.limit]
    table = Table(title=f"{len(sequences)} sequences of {settings.split}, {'2' if settings.pair else '8'} frames")
    for name in ("t0", "labels", "pixels", "P", "R", "F", "mean F", "extracted", "CPU s"):
        table.add_column(name, justify="right")
    for join in settings.join:
        sparse: list[SegmentationScore] = []
        dense: list[SegmentationScore] = []
        seconds: list[float] = []
        shares: list[float] = []
        for sequence in sequences:
            result, true, color, cpu_seconds = segment(sequence, Homc(join=join), settings.pair)
            seconds.append(cpu_seconds)
            pixels = pixel_index(result.positions)
            labels = np.zeros(true.shape, np.int64)
            labels[pixels] = result.labels
            known = np.zeros(true.shape, np.bool_)
            known[pixels] = True
            shares.append(float(known.mean()))
            if known.any():
                sparse.append(score_segmentation(true[known][None], labels[known][None].astype(np.int32)))
            dense_labels = densify(result.positions, result.labels, result.lab, lab_image(color))
            dense.append(score_segmentation(true, dense_labels.astype(np.int32)))
        table.add_row(f"{join:g}", "sparse", f"{np.mean(shares):.1%}", *cells(sparse), f"{np.mean(seconds):.1f}")
        table.add_row(f"{join:g}", "dense", "100%", *cells(dense), f"{np.mean(seconds):.1f}")
    Console().print(table)


def segment(
    sequence: list[SequenceRow], method: Homc, pair: bool
) -> tuple[Segmentation, LabelImage, UInt8Array, float]:
    """Labelled tracks, ground truth and colour of frame 80, and CPU seconds."""
    numbers = [row.frame for row in sequence]
    prev, curr = numbers.index(PREV_FRAME), numbers.index(CURR_FRAME)
    frames = [row.image for row in sequence]
    truth, color = sequence[curr].labels, frames[curr].color
    if pair:
        frames = [frames[prev], frames[curr]] * method.repeats
        prev, curr = len(frames) - 2, len(frames) - 1
    start = time.process_time()
    return method.segment(frames, prev, curr), truth, color, time.process_time() - start


def cells(scores: list[SegmentationScore]) -> list[str]:
    """P, R and F as defined for FBMS-59, the mean F, and the number of extracted objects."""
    P, R, F = np.mean([score.fbms for score in scores], axis=0)
    mean = np.mean([score.mean_f.f for score in scores])
    counts = f"{sum(s.fbms_extracted for s in scores)}/{sum(s.true_objects for s in scores)}"
    return [f"{P:.3f}", f"{R:.3f}", f"{F:.3f}", f"{mean:.3f}", counts]


if __name__ == "__main__":
    main(tyro.cli(Settings))
