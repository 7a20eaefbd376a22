"""The two passes of an evaluation with methods that succeed, fail, or return invalid results."""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from helpers import small_sets
from objectflow import geometry
from objectflow.errors import DatasetError, MethodError, ResultError
from objectflow.evaluation.cache import read_prediction
from objectflow.evaluation.data.sources import PairSet, open_set
from objectflow.evaluation.methods import parse_methods
from objectflow.evaluation.predict import PredictionProgress, predict
from objectflow.evaluation.results import Evaluation
from objectflow.evaluation.score import NOT_CACHED, CachedPairs, score
from objectflow.frame import RgbdFrame
from objectflow.methods.registry import METHODS, MethodEntry
from objectflow.motion import ObjectMotion, SceneMotion

CALLS: list[str] = []


@dataclass(frozen=True)
class Moody:
    """Reports that label 1 moved by 6 cm, unless its mood makes it fail."""

    camera: str = "auto"
    mood: str = "good"

    def __call__(self, prev: RgbdFrame, curr: RgbdFrame) -> SceneMotion:
        CALLS.append(f"{self.mood} {curr.name}")
        bad = curr.name in ("test-000001", "test-000001/80")
        if self.mood == "raises" and bad:
            raise RuntimeError("two\nlines")
        if self.mood == "bad" and bad:
            raise DatasetError("its own words")
        if self.mood == "nothing" and bad:
            return None  # type: ignore[return-value]
        if self.mood == "small" and bad:
            return _motion(prev.resized(32, 24), 0)
        if self.mood == "slow":
            time.sleep(0.02)
        if self.mood == "never":
            raise RuntimeError("no")
        if self.mood == "negative":
            found = _motion(curr, 0)
            found.labels[0, 0] = -1
            return found
        return _motion(curr, 0.06)


@dataclass(frozen=True)
class Whole:
    """A method that takes sequences."""

    camera: str = "auto"

    def __call__(self, prev: RgbdFrame, curr: RgbdFrame) -> SceneMotion:
        CALLS.append("pair")
        return _motion(curr, 0)

    def estimate_in_sequence(self, frames: Sequence[RgbdFrame], prev: int, curr: int) -> SceneMotion:
        CALLS.append(f"{len(frames)} {prev} {curr}")
        return _motion(frames[curr], 0.06)


def _motion(curr: RgbdFrame, shift: float) -> SceneMotion:
    labels = np.zeros(curr.depth.shape, np.int32)
    near = (curr.depth > 0) & (curr.depth < 0.7)
    labels[:24][near[:24]] = 1
    prev_T_curr = geometry.make_transform(np.eye(3), np.array([-shift, 0, 0]))
    flow = geometry.flow_from_motions(geometry.back_project(curr.depth, curr.camera), labels, {1: prev_T_curr})
    objects = (ObjectMotion(1, int((labels == 1).sum()), 1.0, True, np.zeros(3), prev_T_curr),)
    return SceneMotion(labels, flow, objects, seconds=123.0)


@pytest.fixture(autouse=True)
def methods(monkeypatch: pytest.MonkeyPatch) -> None:
    CALLS.clear()
    monkeypatch.setitem(METHODS, "moody", MethodEntry("", __name__, "Moody"))
    monkeypatch.setitem(METHODS, "whole", MethodEntry("", __name__, "Whole"))


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> PairSet:
    return open_set(str(small_sets.write_box_pairs(tmp_path_factory.mktemp("data") / "set", 4)))


def run(pairs: PairSet, out: Path, *texts: str, limit: int | None = None, workers: int = 1) -> Evaluation:
    specs = parse_methods(texts)
    predict(pairs, pairs.keys[:limit], specs, out, workers=workers)
    return score(pairs, pairs.keys[:limit], specs, out)


def test_a_right_answer_scores_as_one(data: PairSet, tmp_path: Path) -> None:
    (method,) = run(data, tmp_path, "moody").methods
    assert method.summary is not None
    assert method.failures == ()
    # Label 1 is found, and label 2, which is static, is not; the background is right except for label 2's pixels.
    assert method.summary.mean_f.extracted == 4
    assert method.summary.mean_f.true_objects == 8
    background = 64 * 48 - 12 * 12 - 12 * 16
    f = 2 * background / (2 * background + 12 * 16)
    assert method.summary.mean_f.f.value == pytest.approx((f + 1 + 0) / 3)
    # The flow is right everywhere, up to the rounding of the cache.
    assert method.summary.flow_all.epe_cm.value < 0.009
    assert method.summary.objects.translation_cm.value == pytest.approx(0, abs=1e-9)
    # Seconds are measured and not taken from the method.
    assert all(found.seconds < 60 for found in method.scores)


def test_facts_and_pictures_behind_the_numbers(data: PairSet, tmp_path: Path) -> None:
    evaluation = run(data, tmp_path, "moody", "moody:mood=never")
    assert (evaluation.data, evaluation.kind, evaluation.split, evaluation.total) == ("set", "pairs", "test", 4)
    assert [pair.key for pair in evaluation.pairs] == list(data.keys)
    assert evaluation.pairs[0].number == 2
    assert evaluation.pairs[0].displacement_cm == pytest.approx((6 + 0) / 2)
    assert evaluation.pairs[0].symmetric_share == 0.5
    source = CachedPairs(data, parse_methods(["moody", "moody:mood=never"]), tmp_path)
    found = source.prediction("moody", data.keys[2])
    assert found is not None
    assert found.objects[0].id == 1
    assert source.prediction("moody:mood=never", data.keys[2]) is None
    assert np.array_equal(source.pair(data.keys[2]).curr.color, data.pair(data.keys[2]).curr.color)


@pytest.mark.parametrize(
    ("mood", "reason"),
    [
        ("raises", "RuntimeError: two lines"),
        ("bad", "its own words"),
        ("nothing", "it returned NoneType, not a SceneMotion"),
        ("small", r"its result is (24, 32), the frame (48, 64)"),
    ],
)
def test_a_failure_is_named_and_stops_nothing(mood: str, reason: str, data: PairSet, tmp_path: Path) -> None:
    evaluation = run(data, tmp_path, f"bad=moody:mood={mood}", "moody")
    bad, good = evaluation.methods
    (failure,) = bad.failures
    assert failure.key == "test-000001"
    assert reason in failure.reason
    assert "\n" not in failure.reason
    assert len(bad.scores) == 3
    assert len(good.scores) == 4


def test_a_method_that_always_fails_has_no_summary(data: PairSet, tmp_path: Path) -> None:
    never, negative = run(data, tmp_path, "moody:mood=never", "moody:mood=negative").methods
    assert (never.summary, len(never.failures), never.scores) == (None, 4, ())
    assert "negative" in negative.failures[0].reason


def test_what_is_cached_is_not_run_again(data: PairSet, tmp_path: Path) -> None:
    first = run(data, tmp_path, "moody", limit=2)
    assert len(CALLS) == 2
    again = run(data, tmp_path, "moody", limit=2)
    assert len(CALLS) == 2
    assert again.to_json() == first.to_json()
    more = run(data, tmp_path, "moody", "moody:mood=raises")
    assert CALLS[2:] == [f"good {key}" for key in data.keys[2:]] + [f"raises {key}" for key in data.keys]
    assert (len(more.pairs), more.total) == (4, 4)
    # Only failures are tried again.
    run(data, tmp_path, "moody", "moody:mood=raises")
    assert CALLS[8:] == ["raises test-000001"]


@pytest.mark.parametrize("damage", ["half", "empty", "text", "gone"])
def test_a_broken_file_is_made_again(damage: str, data: PairSet, tmp_path: Path) -> None:
    run(data, tmp_path, "moody")
    path = tmp_path / "predictions" / "moody" / "test-000002.npz"
    whole = path.read_bytes()
    if damage == "gone":
        path.unlink()
    else:
        path.write_bytes({"half": whole[: len(whole) // 2], "empty": b"", "text": b"no archive"}[damage])
    # Scoring alone counts it as a failure.
    (scored,) = score(data, data.keys, parse_methods(["moody"]), tmp_path).methods
    assert [(one.key, one.reason) for one in scored.failures] == [("test-000002", NOT_CACHED)]
    CALLS.clear()
    assert len(run(data, tmp_path, "moody").methods[0].scores) == 4
    assert CALLS == ["good test-000002"]
    read_prediction(path)


def test_other_settings_and_other_data_are_not_mixed(data: PairSet, tmp_path: Path) -> None:
    run(data, tmp_path, "m=moody", limit=1)
    with pytest.raises(ResultError, match=r"m was made with options = .*good.*, now it is .*slow"):
        run(data, tmp_path, "m=moody:mood=slow", limit=1)
    with pytest.raises(ResultError, match='with method = "moody", now it is "zero"'):
        run(data, tmp_path, "m=zero", limit=1)
    other = open_set(str(small_sets.write_box_pairs(tmp_path / "other", 4, seed=5)))
    with pytest.raises(ResultError, match="predictions of another data set"):
        run(other, tmp_path, "m=moody", limit=1)
    assert len(CALLS) == 1


def test_methods_that_take_sequences_get_them(data: PairSet, tmp_path: Path) -> None:
    sequences = open_set(str(small_sets.write_sequences(tmp_path / "set")), sequences="paper")
    whole, moody = run(sequences, tmp_path / "out", "whole", "moody").methods
    assert CALLS == ["8 0 6", "8 0 6", "good test-000000/80", "good test-000001/80"]
    assert whole.summary is not None
    assert moody.summary is not None
    assert whole.summary.flow_all == moody.summary.flow_all
    assert (tmp_path / "out" / "predictions" / "whole" / "test-000001%2F80.npz").is_file()
    CALLS.clear()
    run(data, tmp_path / "pairs", "whole", limit=1)
    assert CALLS == ["pair"]


def test_oracles_see_the_truth(data: PairSet, tmp_path: Path) -> None:
    masks, motion, moody = run(data, tmp_path, "oracle-masks", "oracle-motion", "moody", limit=2).methods
    assert (masks.oracle, motion.oracle, moody.oracle) == (True, True, False)
    assert masks.summary is not None
    assert masks.summary.mean_f.f.value == 1
    assert motion.summary is not None
    assert motion.summary.flow_masked.epe_cm.value < 0.009


def test_runtime_leaves_out_each_processs_first(data: PairSet, tmp_path: Path) -> None:
    (method,) = run(data, tmp_path, "moody:mood=slow").methods
    assert method.summary is not None
    runtime = method.summary.runtime
    assert (runtime.pairs, runtime.warm_up) == (3, 1)
    assert runtime.median >= 0.02
    assert [read_prediction(path).cold for path in sorted(tmp_path.rglob("*.npz"))] == [True, False, False, False]


def test_workers_make_the_same_predictions(data: PairSet, tmp_path: Path) -> None:
    one = run(data, tmp_path / "one", "zero", "dense-flow", "oracle-motion")
    two = run(data, tmp_path / "two", "zero", "dense-flow", "oracle-motion", workers=2)
    for a, b in zip(one.methods, two.methods, strict=True):
        assert [score.flow for score in a.scores] == [score.flow for score in b.scores]
        assert [score.segmentation for score in a.scores] == [score.segmentation for score in b.scores]
        assert b.summary is not None
        assert b.summary.runtime.machine.endswith("2 at a time")
    with pytest.raises(MethodError, match="--workers must be at least 1"):
        run(data, tmp_path / "none", "zero", workers=0)


def test_ray_makes_the_same_predictions(data: PairSet, tmp_path: Path) -> None:
    pytest.importorskip("ray", reason="Ray is not installed (pip install objectflow[ray])")
    specs = parse_methods(["dense-flow"])
    predict(data, data.keys, specs, tmp_path / "ray", workers=2, ray="local")
    (a,) = score(data, data.keys, specs, tmp_path / "ray").methods
    (b,) = run(data, tmp_path / "here", "dense-flow").methods
    assert [score.flow for score in a.scores] == [score.flow for score in b.scores]


def test_progress_and_settings(data: PairSet, tmp_path: Path) -> None:
    said: list[PredictionProgress] = []
    predict(data, data.keys, parse_methods(["moody:mood=bad"]), tmp_path, report=said.append)
    assert [(now.done, now.total, now.failed) for now in said] == [
        (0, 4, 0),
        (1, 4, 0),
        (2, 4, 1),
        (3, 4, 1),
        (4, 4, 1),
    ]
    settings = json.loads((tmp_path / "predictions" / "moody_mood=bad" / "settings.json").read_text())
    assert settings["sha256"] == data.sha256
    assert settings["options"] == {"camera": "auto", "mood": "bad"}


def test_no_pairs_at_all(data: PairSet, tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="no pairs to evaluate"):
        score(data, [], parse_methods(["zero"]), tmp_path)
