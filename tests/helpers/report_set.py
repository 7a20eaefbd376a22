"""A small evaluation on analytic scenes, kept in memory."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from analytic import make_scene
from helpers.truths import truth_of_scene
from objectflow import geometry, load
from objectflow.evaluation.metrics.pair_score import PairScore, score_pair
from objectflow.evaluation.results import Evaluation, EvaluationPair, Failure, MethodResult, facts_of
from objectflow.evaluation.tables.summary import summarise
from objectflow.motion import ObjectMotion, SceneMotion

Method = Callable[[EvaluationPair], SceneMotion]


@dataclass(frozen=True, eq=False)
class MemorySource:
    """A `PairSource` that serves pairs and predictions from memory."""

    pairs: dict[str, EvaluationPair]
    predictions: dict[tuple[str, str], SceneMotion]

    def pair(self, key: str) -> EvaluationPair:
        return self.pairs[key]

    def prediction(self, label: str, key: str) -> SceneMotion | None:
        return self.predictions.get((label, key))


def make_set(
    count: int,
    *,
    size: tuple[int, int] = (160, 120),
    methods: dict[str, Method] | None = None,
    fail: tuple[str, str] | None = None,
    name: str = "analytic",
    failure: str = "no luck",
) -> tuple[Evaluation, MemorySource]:
    """Evaluate methods on `count` scenes of size (width, height); `fail` is a (label, key) that has no result."""
    chosen = {"zero": estimate_zero, "noisy": estimate_noisy} if methods is None else methods
    pairs = {f"{name}-{seed:04d}": make_pair(f"{name}-{seed:04d}", seed, size) for seed in range(count)}
    predictions = {(label, key): run(pair) for label, run in chosen.items() for key, pair in pairs.items()}
    if fail is not None:
        del predictions[fail]
    results = []
    for label in chosen:
        scores = tuple(
            score_pair(predictions[label, key], pair.truth) for key, pair in pairs.items() if (label, key) != fail
        )
        failures = tuple(Failure(key, failure) for key in pairs if (label, key) == fail)
        results.append(_result(label, scores, failures))
    facts = tuple(facts_of(pair.truth) for pair in pairs.values())
    found = Evaluation(
        name, "pairs", "test", "0123456789abcdef" * 4, count, "a machine", "0.1.0", facts, tuple(results)
    )
    return found, MemorySource(pairs, predictions)


def make_pair(key: str, seed: int, size: tuple[int, int]) -> EvaluationPair:
    """One analytic scene with exact truth."""
    scene = make_scene(seed, width=size[0], height=size[1], objects=(2, 5))
    truth = truth_of_scene(scene, key, scene_name=f"scene-{seed}")
    return EvaluationPair(scene.prev, scene.curr, truth)


def estimate_zero(pair: EvaluationPair) -> SceneMotion:
    """A result without motion."""
    return load("zero")(pair.prev, pair.curr)


def estimate_noisy(pair: EvaluationPair) -> SceneMotion:
    """The truth with renumbered objects, without the last object, and with noise on the flow."""
    truth = pair.truth
    rng = np.random.default_rng(len(truth.key))
    seen = truth.objects[:-1]
    labels = np.zeros_like(truth.labels)
    objects = []
    for number, obj in enumerate(reversed(seen), start=1):
        labels[truth.labels == obj.label] = number
        pixels = int((labels == number).sum())
        objects.append(ObjectMotion(number, pixels, 1.0, True, obj.center, obj.prev_T_curr))
    points = geometry.back_project(pair.curr.depth, pair.curr.camera)
    flow = geometry.flow_from_motions(points, labels, {obj.id: obj.prev_T_curr for obj in objects}, None)
    noisy = (flow + rng.normal(0, 0.003, flow.shape)).astype(np.float32)
    return SceneMotion(labels=labels, scene_flow=noisy, objects=tuple(objects), method="noisy", seconds=0.01)


def _result(label: str, scores: tuple[PairScore, ...], failures: tuple[Failure, ...]) -> MethodResult:
    summary = summarise(scores, np.random.default_rng(0), machine="a machine") if scores else None
    return MethodResult(label, label, {}, label.startswith("oracle"), summary, failures, scores)
