"""Pairs per second that the metrics score on one core: `OMP_NUM_THREADS=1 python benchmarks/scoring.py`.

The truth is discs of known motion on a plane, every second one with symmetry axes. Predictions are the truth, shifted
by a few pixels and with noise on the flow. `with read` includes reading them from compressed files, as in `evaluate`.
"""

from __future__ import annotations

import dataclasses
import os
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

from objectflow import Camera, ObjectMotion, RgbdFrame, SceneMotion, geometry
from objectflow.evaluation.cache import encode, read_prediction
from objectflow.evaluation.data.sources import open_set
from objectflow.evaluation.data.truth import PairTruth, TrueObject, make_pair_truth
from objectflow.evaluation.methods import parse_methods
from objectflow.evaluation.metrics.flow_metrics import score_flow
from objectflow.evaluation.metrics.object_metrics import score_objects
from objectflow.evaluation.metrics.pair_score import score_pair
from objectflow.evaluation.metrics.segmentation_metrics import score_segmentation
from objectflow.evaluation.predict import predict
from objectflow.evaluation.runtime import machine_name
from objectflow.evaluation.score import score


@dataclasses.dataclass
class Settings:
    """Measures the metrics."""

    width: int = 320
    """Image width; the height is three quarters of it."""
    objects: tuple[int, ...] = (2, 6, 12, 24)
    """Numbers of objects per pair, one row each."""
    pairs: int = 20
    """Number of pairs per row."""
    repeats: int = 3
    """Number of runs, of which the fastest is reported."""


def make_pair(width: int, objects: int, rng: np.random.Generator) -> tuple[SceneMotion, PairTruth]:
    """A prediction with errors of a few pixels and centimetres, and the truth."""
    height = width * 3 // 4
    camera = Camera(width=width, height=height, fx=0.9 * width, fy=0.9 * width, cx=width / 2, cy=height / 2)
    rows, columns = np.mgrid[:height, :width]
    labels = np.zeros((height, width), np.int32)
    motions = geometry.se3_exp(rng.normal(0, 0.1, size=(objects, 6)))
    for label in range(1, objects + 1):
        row, column, radius = rng.uniform(0, height), rng.uniform(0, width), rng.uniform(0.05, 0.15) * width
        labels[(rows - row) ** 2 + (columns - column) ** 2 < radius**2] = label
    depth = np.full((height, width), 0.9, np.float32)
    depth[rng.random((height, width)) < 0.05] = 0
    frame = RgbdFrame(color=np.zeros((height, width, 3), np.uint8), depth=depth, camera=camera)
    axes = {0: ((), ()), 1: (np.eye(3), (4, 2, 2))}
    true = [
        TrueObject(k + 1, np.array([0, 0, 0.9]), T, np.array(axes[k % 2][0]).reshape(-1, 3), axes[k % 2][1], True)
        for k, T in enumerate(motions)
    ]
    truth = make_pair_truth("pair", frame, labels, true)
    guess = np.roll(labels, rng.integers(-4, 5, size=2), axis=(0, 1))
    noise = rng.normal(0, 0.02, size=(height, width, 3)).astype(np.float32)
    found = tuple(
        ObjectMotion(k + 1, int((guess == k + 1).sum()), 1.0, True, np.array([0, 0, 0.9]), T)
        for k, T in enumerate(geometry.se3_exp(rng.normal(0, 0.02, size=(objects, 6))) @ motions)
    )
    return SceneMotion(guess, truth.scene_flow + noise, found), truth


def best(run: Callable[[], object], repeats: int) -> float:
    """CPU seconds of the fastest run, which other processes hardly affect."""
    seconds = []
    for _ in range(repeats):
        start = time.process_time()
        run()
        seconds.append(time.process_time() - start)
    return min(seconds)


def main(settings: Settings) -> None:
    rng = np.random.default_rng(0)
    threads = os.environ.get("OMP_NUM_THREADS", "all")
    size = f"{settings.width}x{settings.width * 3 // 4}"
    table = Table(title=f"Scoring {size}, pairs/s ({machine_name()}, {threads} thread(s))")
    for column in ("objects", "flow", "segmentation", "objects' motions", "all metrics", "with read"):
        table.add_column(column, justify="right")
    for count in settings.objects:
        pairs = [make_pair(settings.width, count, rng) for _ in range(settings.pairs)]
        matches = [score_segmentation(truth.labels, guess.labels).matches for guess, truth in pairs]
        with tempfile.TemporaryDirectory() as folder:
            for k, (guess, _) in enumerate(pairs):
                (Path(folder) / f"{k}.npz").write_bytes(encode(guess, key=str(k), cold=False, machine=""))
            seconds = [
                best(run, settings.repeats)
                for run in (
                    lambda pairs=pairs: [
                        score_flow(guess.scene_flow, truth.scene_flow, truth.masked, truth.masked)
                        for guess, truth in pairs
                    ],
                    lambda pairs=pairs: [score_segmentation(truth.labels, guess.labels) for guess, truth in pairs],
                    lambda pairs=pairs, matches=matches: [
                        score_objects(guess.objects, truth, found)
                        for (guess, truth), found in zip(pairs, matches, strict=True)
                    ],
                    lambda pairs=pairs: [score_pair(guess, truth) for guess, truth in pairs],
                    lambda pairs=pairs, folder=folder: [
                        score_pair(read_prediction(Path(folder) / f"{k}.npz").motion, truth)
                        for k, (_, truth) in enumerate(pairs)
                    ],
                )
            ]
        table.add_row(str(count), *(f"{len(pairs) / value:.0f}" for value in seconds))
    Console().print(table)
    Console().print(
        f"the whole second pass on the packaged set, one method: {whole_pass(settings.repeats):.0f} pairs/s"
    )


def whole_pass(repeats: int) -> float:
    """Pairs per second of the second pass of `evaluate` on the packaged set, including truth and summaries."""
    pairs, methods = open_set("tiny"), parse_methods(["dense-flow"])
    with tempfile.TemporaryDirectory() as folder:
        predict(pairs, pairs.keys, methods, Path(folder))
        return len(pairs.keys) / best(lambda: score(pairs, pairs.keys, methods, Path(folder)), repeats)


if __name__ == "__main__":
    main(tyro.cli(Settings))
