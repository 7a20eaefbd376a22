"""Released weights, in the package and beside it: intact, and useful on pairs that they were not trained on."""

from __future__ import annotations

import dataclasses
import hashlib
from pathlib import Path

import numpy as np
import pytest

import objectflow
from helpers.paths import ROOT
from objectflow.evaluation.data.sources import TINY, open_set
from objectflow.evaluation.metrics.flow_metrics import score_flow
from objectflow.evaluation.metrics.segmentation_metrics import score_segmentation
from objectflow.methods import find_weights

PAIRS = 16
PAPER = ROOT / "weights"
"""Weights of the paper's network, which are not in the package."""
RELEASED = [*find_weights.packaged_weights(), *sorted(PAPER.glob("*.safetensors"))]


def test_the_default_methods_weights_are_packaged_and_the_papers_are_in_the_repository() -> None:
    assert [path.stem for path in RELEASED] == [objectflow.DEFAULT_METHOD, "sceneflownet-c-vl"]


@pytest.mark.parametrize("path", RELEASED, ids=lambda path: path.stem)
def test_the_card_names_the_hash_of_the_file(path: Path) -> None:
    assert hashlib.sha256(path.read_bytes()).hexdigest() in path.with_suffix(".md").read_text(encoding="utf-8")
    assert path.stat().st_size < 25 * 2**20


@pytest.mark.parametrize("path", RELEASED, ids=lambda path: path.stem)
def test_the_networks_results_are_better_than_no_motion(path: Path) -> None:
    estimator = objectflow.load(path.stem, weights=path, camera="static", device="cpu")
    pairs = open_set(TINY)
    error, zero_error, f_measure = [], [], []
    for key in pairs.keys[:PAIRS]:
        pair = pairs.pair(key)
        motion = estimator(pair.prev, pair.curr)
        truth = pair.truth
        error.append(score_flow(motion.scene_flow, truth.scene_flow, truth.masked, truth.masked).masked.epe_cm)
        zero = np.zeros_like(truth.scene_flow)
        zero_error.append(score_flow(zero, truth.scene_flow, truth.masked, truth.masked).masked.epe_cm)
        f_measure.append(score_segmentation(truth.labels, motion.labels).mean_f.f)
    assert np.mean(error) < 0.9 * np.mean(zero_error)
    assert np.mean(f_measure) > 0.5


def test_nothing_moves_between_a_frame_and_itself() -> None:
    """Nor where its depth is measured twice: spurious motions of the network fail the static test."""
    estimator = objectflow.load("rigidmatch", camera="static", device="cpu")
    pairs = open_set(TINY)
    rng = np.random.default_rng(0)
    for key in pairs.keys[:PAIRS:4]:
        frame = pairs.pair(key).curr
        noise = rng.normal(size=frame.depth.shape).astype(np.float32)
        again = dataclasses.replace(frame, depth=np.where(frame.valid, frame.depth + 0.001 * noise, 0))
        for prev in (frame, again):
            motion = estimator(prev, frame)
            assert not any(obj.moving for obj in motion.objects)
            assert np.nanmax(np.linalg.norm(motion.scene_flow, axis=-1)) < 0.005
