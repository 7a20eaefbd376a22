"""Whether scores mean what they say, on a generated set: `python benchmarks/calibration.py --data data --split val`.

Prints a reliability table: for every bin of scores the number of objects that were predicted to move, and the share of
them whose motion is right. With `--results`, the results are those that `objectflow evaluate` wrote before.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
import tyro
from rich.progress import track

import objectflow
from objectflow import geometry
from objectflow.evaluation.cache import MethodCache
from objectflow.evaluation.data.sources import open_set
from objectflow.evaluation.data.truth import PairTruth, TrueObject
from objectflow.evaluation.metrics.symmetry_error import displacement_error
from objectflow.frame import RgbdFrame
from objectflow.motion import ObjectMotion, SceneMotion
from objectflow.typing import Float32Array

BINS = (0.0, 0.3, 0.5, 0.7, 0.9, 1.0)
"""Edges of the bins of scores; the last bin includes 1."""
MAX_ERROR = 0.01
"""Metres: mean displacement error of the true object's points up to which a motion is right."""
MAX_RELATIVE_ERROR = 0.2
"""The same as a share of the object's true displacement against the background."""
MAX_SMALL_ERROR = 0.5
"""The same share of an object that moved by less than the evaluation counts as moving, such as 3 mm."""
MIN_INSIDE = 0.5
"""Share of a predicted mask that must lie on one true object."""


@dataclass
class Settings:
    """The reliability table of a method's scores."""

    data: Path
    """Folder of a generated set."""
    split: str = "val"
    """Its split."""
    limit: int = 100
    """Largest number of pairs."""
    method: str = "rigidmatch"
    """Name of the method."""
    camera: Literal["auto", "static", "moving"] = "auto"
    """See `objectflow estimate --camera`."""
    results: Path | None = None
    """The folder that `objectflow evaluate --out` wrote for this set; its results are judged instead of new ones."""


class ScoredMover(NamedTuple):
    """An object that was predicted to move: its score, and whether its motion is right."""

    score: float
    right: bool


def main(settings: Settings) -> None:
    pairs = open_set(str(settings.data), split=settings.split)
    keys = pairs.keys[: settings.limit]
    estimate = results(settings.results, settings.method) if settings.results else estimates(settings)
    movers: list[ScoredMover] = []
    for key in track(keys, "pairs"):
        pair = pairs.pair(key)
        points = geometry.back_project(pair.curr.depth, pair.curr.camera)
        movers += judge_movers(estimate(key, pair.prev, pair.curr), pair.truth, points)
    print(f"{settings.method} on {len(keys)} pairs of {settings.data.name}, camera={settings.camera}\n")
    print("\n".join(reliability_rows(movers)))


def estimates(settings: Settings) -> Callable[[str, RgbdFrame, RgbdFrame], SceneMotion]:
    """Results of the method."""
    estimator = objectflow.load(settings.method, camera=settings.camera)
    return lambda _, prev, curr: estimator(prev, curr)


def results(folder: Path, method: str) -> Callable[[str, RgbdFrame, RgbdFrame], SceneMotion]:
    """Results that were written before, by the keys of their pairs."""
    cache = MethodCache(folder / "predictions" / method)

    def read(key: str, _: RgbdFrame, __: RgbdFrame) -> SceneMotion:
        found = cache.read(key)
        if found is None:
            raise SystemExit(f"{cache.folder} has no result of {key}: evaluate the set, or lower --limit")
        return found.motion

    return read


def judge_movers(motion: SceneMotion, truth: PairTruth, points: Float32Array) -> Iterator[ScoredMover]:
    """Compare the motion of every object that was predicted to move with that of the true object that it shows.

    The motion of a part of an object is right if it is that of the whole.

    Args:
        motion: the prediction.
        truth: of the pair.
        points: (H, W, 3) metres of the current frame.
    """
    by_label = {obj.label: obj for obj in truth.objects}
    for obj in motion.moving:
        shown = truth.labels[motion.labels == obj.id]
        counts = np.bincount(shown, minlength=1)
        label = int(counts[1:].argmax()) + 1 if len(counts) > 1 else 0
        right = label in by_label and counts[label] >= MIN_INSIDE * len(shown)
        if right:
            seen = points[truth.labels == label]
            right = is_right(obj, by_label[label], seen[np.isfinite(seen[:, 2])], truth)
        yield ScoredMover(obj.score, bool(right))


def is_right(found: ObjectMotion, true: TrueObject, points: Float32Array, truth: PairTruth) -> bool:
    """Whether a motion carries the points (N, 3) of a true object to where they were, up to its symmetry."""
    if not len(points):
        return False
    before = geometry.transform(true.prev_T_curr, points)
    background = truth.background_prev_T_curr
    at_rest = points if background is None else geometry.transform(background, points)
    displacement = np.linalg.norm(before - at_rest, axis=1).mean()
    error = displacement_error(found.prev_T_curr, true.prev_T_curr, points, true.center, true.axes, true.orders)
    if true.label not in truth.moving:
        return bool(displacement > 0 and error <= MAX_SMALL_ERROR * displacement)
    return bool(error <= max(MAX_ERROR, MAX_RELATIVE_ERROR * displacement))


def reliability_rows(movers: list[ScoredMover]) -> Iterator[str]:
    """Lines of a Markdown table: score, number of movers, share whose motion is right."""
    yield "| score | movers | right |"
    yield "|---|---|---|"
    for low, high in pairwise(BINS):
        inside = [one.right for one in movers if low <= one.score < high or (high == BINS[-1] and one.score == high)]
        share = f"{np.mean(inside):.0%}" if inside else "-"
        yield f"| {low:g} to {high:g} | {len(inside)} | {share} |"


if __name__ == "__main__":
    main(tyro.cli(Settings))
