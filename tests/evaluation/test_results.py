"""The plain data of an evaluation: facts of a pair, computed by hand, and the JSON round trip."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest

from helpers.cameras import small_camera
from helpers.truths import true_object
from objectflow import geometry
from objectflow.errors import DatasetError
from objectflow.evaluation.data.truth import PairTruth, make_pair_truth
from objectflow.evaluation.metrics.flow_metrics import FlowScore, PixelScore
from objectflow.evaluation.metrics.object_metrics import ObjectError
from objectflow.evaluation.metrics.pair_score import PairScore
from objectflow.evaluation.metrics.region_scores import RegionScore, score_regions
from objectflow.evaluation.metrics.segmentation_metrics import PRF, ObjectMatch, SegmentationScore
from objectflow.evaluation.results import Evaluation, Failure, MethodResult, PairFacts, facts_of
from objectflow.evaluation.tables.summary import summarise
from objectflow.frame import RgbdFrame

NAN = math.nan


def truth() -> PairTruth:
    """Two objects of 4 and 2 pixels in an 8x6 image; the first moves 3 cm and rotates by 90 degrees, the second is
    visible in one frame only."""
    depth = np.ones((6, 8), np.float32)
    frame = RgbdFrame(color=np.zeros((6, 8, 3), np.uint8), depth=depth, camera=small_camera(8, 6))
    labels = np.zeros((6, 8), np.int32)
    labels[1:3, 1:3], labels[4, 5:7] = 1, 2
    center, quarter = np.array([0.1, 0.2, 1.0]), geometry.so3_exp(np.array([0, 0, math.pi / 2]))
    moved = geometry.make_transform(quarter, center + np.array([0, 0, 0.03]) - quarter @ center)
    objects = [
        true_object(1, center, moved, axes=(0, 0, 1), orders=(4,)),
        true_object(2, center, in_both=False, rotation_known=False),
    ]
    return make_pair_truth("a", frame, labels, objects, scene="s")


def test_facts_of_a_pair() -> None:
    facts = facts_of(truth())
    first, second = facts.objects
    assert (facts.key, facts.scene, facts.width, facts.height, facts.number) == ("a", "s", 8, 6, 2)
    assert (first.pixels, first.symmetric, first.moving, first.in_both) == (4, True, True, True)
    assert (first.displacement_cm, first.rotation_deg) == pytest.approx((3, 90))
    assert (second.pixels, second.symmetric, second.moving, second.in_both) == (2, False, False, False)
    assert math.isnan(second.rotation_deg)
    # Means are over the object that is visible in both frames.
    assert (facts.displacement_cm, facts.rotation_deg) == pytest.approx((3, 90))
    assert (facts.visible_pixels, facts.symmetric_share) == (4, 1)
    assert math.isnan(PairFacts("b", "b", 8, 6, ()).displacement_cm)


def test_regions_score_each_object_on_its_own_pixels() -> None:
    true = truth()
    predicted = true.scene_flow.copy()
    predicted[1, 1, 0] += 0.04  # an error of 4 cm at one of four pixels: 1 cm on average
    predicted[4, 5:7] = np.nan
    matched = score_regions(predicted, true, [ObjectMatch(1, 7, 0.8)])[0]
    assert (matched.label, matched.f) == (1, 0.8)
    assert matched.epe_cm == pytest.approx(1, abs=1e-5)
    unmatched = score_regions(predicted, true, [])[1]
    assert unmatched.f == 0
    assert math.isnan(unmatched.epe_cm)


def evaluation() -> Evaluation:
    pixels = PixelScore(1.5, NAN, 10, 8, (1, 2, 3))
    form = PRF(0.5, 0.25, 1 / 3)
    score = PairScore(
        "a",
        "s",
        FlowScore(pixels, pixels, pixels),
        SegmentationScore(form, form, form, form, 1, 2, 3, 4, 5, (ObjectMatch(1, 2, 0.9),)),
        (ObjectError(1, 0.9, NAN, 0.5, True),),
        0.25,
        (RegionScore(1, 0.9, NAN),),
    )
    summary = summarise([score], np.random.default_rng(0), machine="a machine")
    good = MethodResult("fast", "consensus", {"rounds": 1}, False, summary, (Failure("b", "no"),), (score,))
    bad = MethodResult("none", "zero", {}, True, None, (Failure("a", "x"), Failure("b", "y")), ())
    return Evaluation("set", "pairs", "test", "12ab", 9, "m", "0.1.0", (facts_of(truth()),), (good, bad))


def test_json_round_trip(tmp_path: Path) -> None:
    before = evaluation()
    before.write(tmp_path / "results.json")
    after = Evaluation.read(tmp_path / "results.json")
    assert after.to_json() == before.to_json()
    method = after.method("fast")
    assert method.summary is not None
    assert method.summary.runtime == before.methods[0].summary.runtime  # type: ignore[union-attr]
    assert method.scores[0].segmentation == before.methods[0].scores[0].segmentation
    assert math.isnan(method.scores[0].flow.all.aae_deg)
    assert method.score("a") is method.scores[0]
    assert method.score("b") is None
    assert after.method("none").summary is None
    assert after.pairs[0].objects[0] == before.pairs[0].objects[0]
    assert math.isnan(after.pairs[0].objects[1].rotation_deg)


def broken(change: str) -> str:
    values = json.loads(evaluation().to_json())
    if change == "format":
        values["format"] = 99
    elif change == "missing":
        del values["methods"][0]["scores"][0]["flow"]
    elif change == "type":
        values["total"] = "nine"
    elif change == "list":
        values["pairs"] = 3
    return json.dumps(values)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "Expecting value"),
        ("[]", "not the results"),
        ("{}", "'format' is missing"),
        (broken("format"), "format is 99"),
        (broken("missing"), "'flow' is missing"),
        (broken("type"), "total must be of type int, not 'nine'"),
        (broken("list"), "pairs must be a list"),
    ],
)
def test_other_files_are_refused(text: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "results.json").write_text(text)
    with pytest.raises(DatasetError, match=message) as caught:
        Evaluation.read(tmp_path / "results.json")
    assert str(tmp_path) in str(caught.value)
    with pytest.raises(DatasetError, match="no such file"):
        Evaluation.read(tmp_path / "none.json")
