"""Found and false moving objects: cases counted by hand, and the summary of a set of pairs."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from helpers.truths import true_object
from objectflow.evaluation.data.truth import PairTruth
from objectflow.evaluation.metrics.flow_metrics import FlowScore, PixelScore
from objectflow.evaluation.metrics.mover_metrics import MoverScore, score_movers
from objectflow.evaluation.metrics.pair_score import PairScore
from objectflow.evaluation.metrics.segmentation_metrics import PRF, SegmentationScore
from objectflow.evaluation.results import Evaluation, MethodResult, ObjectFacts, PairFacts
from objectflow.evaluation.tables.summary import summarise
from objectflow.evaluation.tables.tables import make_tables
from objectflow.motion import ObjectMotion, SceneMotion
from objectflow.typing import LabelImage

WIDTH, HEIGHT = 40, 30


def draw(*stripes: tuple[int, int, int]) -> LabelImage:
    """Stripes of ten rows, given as (label, first column, last column + 1)."""
    labels = np.zeros((HEIGHT, WIDTH), np.int32)
    for label, start, stop in stripes:
        labels[10:20, start:stop] = label
    return labels


def truth(labels: LabelImage, moving: set[int], hidden: int = 0) -> PairTruth:
    """`hidden` is the label of an object that is not visible in the previous frame."""
    objects = tuple(true_object(label, in_both=label != hidden) for label in np.unique(labels).tolist() if label)
    flow = np.zeros((*labels.shape, 3), np.float32)
    return PairTruth("k", "s", labels, flow, objects, labels > 0, frozenset(moving))


def guess(labels: LabelImage, static: tuple[int, ...] = ()) -> SceneMotion:
    objects = tuple(
        ObjectMotion(label, int((labels == label).sum()), 1.0, label not in static, np.zeros(3), np.eye(4))
        for label in np.unique(labels).tolist()
        if label
    )
    return SceneMotion(labels, np.zeros((*labels.shape, 3), np.float32), objects, None, "m", 0.1)


def test_found_missed_and_surplus() -> None:
    # Object 1: 10 of 10 columns. Object 2: 5 of 10, F = 2 * 5 / 15 = 0.67. A third where nothing moves.
    true = draw((1, 0, 10), (2, 12, 22))
    score = score_movers(guess(draw((7, 0, 10), (8, 12, 17), (9, 30, 35))), truth(true, {1, 2}))
    assert score == MoverScore(true=2, predicted=3, found=1, static=False)


@pytest.mark.parametrize(("columns", "found"), [(10, 1), (7, 1), (6, 1), (5, 0), (16, 1), (17, 0)])
def test_an_object_is_found_from_f_three_quarters_on(columns: int, found: int) -> None:
    """F = 2 * min(10, n) / (10 + n): 0.75 at 6 columns, 0.77 at 16, 0.74 at 17."""
    score = score_movers(guess(draw((1, 0, columns))), truth(draw((1, 0, 10)), {1}))
    assert score == MoverScore(1, 1, found, static=False)


def test_static_objects_need_not_be_found_and_are_false_movers() -> None:
    true = draw((1, 0, 10), (2, 12, 22))
    assert score_movers(guess(true), truth(true, {1})) == MoverScore(1, 2, 1, static=False)
    # Segmenting it as a static object is right.
    assert score_movers(guess(true, static=(2,)), truth(true, {1})) == MoverScore(1, 1, 1, static=False)


def test_an_object_visible_in_one_frame_may_be_found_or_not() -> None:
    true = draw((1, 0, 10), (2, 12, 22))
    everything = truth(true, {1, 2}, hidden=2)
    assert score_movers(guess(true), everything) == MoverScore(1, 1, 1, static=False)
    assert score_movers(guess(draw((1, 0, 10))), everything) == MoverScore(1, 1, 1, static=False)


def test_specks_need_not_be_found() -> None:
    """The limit is 60 pixels in an image of 320 x 240."""
    labels = np.zeros((240, 320), np.int32)
    labels[0, :59] = 1
    assert score_movers(guess(labels * 0), truth(labels, {1})) == MoverScore(0, 0, 0, static=False)
    labels[0, :60] = 1
    assert score_movers(guess(labels * 0), truth(labels, {1})) == MoverScore(1, 0, 0, static=False)


def test_pairs_without_motion() -> None:
    true = draw((1, 0, 10))
    empty = score_movers(guess(draw()), truth(true, set()))
    assert empty == MoverScore(0, 0, 0, static=True)
    assert not empty.false_mover
    assert score_movers(guess(true), truth(true, set())).false_mover
    assert not score_movers(guess(true, static=(1,)), truth(true, set())).false_mover


def pair(number: int, movers: MoverScore) -> PairScore:
    pixels = PixelScore(1.0, 1.0, 100, 100, (10, 50, 90))
    form = PRF(0.5, 0.5, 0.5)
    segmentation = SegmentationScore(form, form, form, form, 0, 0, 0, 1, 1, ())
    return PairScore(f"p{number}", f"s{number}", FlowScore(pixels, pixels, pixels), segmentation, (), 0.5, (), movers)


SCORES = (
    pair(0, MoverScore(3, 2, 2, static=False)),
    pair(1, MoverScore(1, 2, 1, static=False)),
    pair(2, MoverScore(0, 0, 0, static=True)),
    pair(3, MoverScore(0, 1, 0, static=True)),
    pair(4, MoverScore(0, 0, 0, static=True)),
)


def test_a_set_pools_objects_and_counts_pairs() -> None:
    movers = summarise(SCORES, np.random.default_rng(0)).movers
    assert (movers.found, movers.true, movers.static_pairs) == (3, 4, 3)
    assert movers.precision.value == pytest.approx(3 / 5)
    assert movers.recall.value == pytest.approx(3 / 4)
    assert movers.no_false_mover.value == pytest.approx(2 / 3)
    assert math.isnan(summarise(SCORES[:2], np.random.default_rng(0)).movers.no_false_mover.value)


def test_the_table_is_printed_if_there_are_pairs_without_motion() -> None:
    summary = summarise(SCORES, np.random.default_rng(0), machine="M")
    method = MethodResult("ours", "consensus", {}, False, summary, (), SCORES)
    mover = ObjectFacts(1, 500, 3.0, 10.0, False, True, True)
    pairs = tuple(PairFacts(s.key, s.scene, 320, 240, () if s.movers.static else (mover,)) for s in SCORES)
    evaluation = Evaluation("set", "pairs", "test", "ab", 5, "M", "0", pairs, (method,))
    table = next(one for one in make_tables(evaluation).tables if one.name == "movers")
    cells = table.rows[0].cells
    assert table.main
    assert (cells["found"].value, cells["found"].total) == (3, 4)
    assert (cells["static_pairs"].value, cells["static_pairs"].total) == (3, 5)
    assert cells["no_false_mover"].value == pytest.approx(2 / 3)
    assert [column.heading for column in table.columns][-1] == "no false mover"
    moving = replace(evaluation, methods=(replace(method, summary=summarise(SCORES[:2], np.random.default_rng(0))),))
    assert not next(one for one in make_tables(moving).tables if one.name == "movers").main
