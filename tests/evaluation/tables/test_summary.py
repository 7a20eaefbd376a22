"""Averages over a set of three pairs, computed by hand, and their bootstrap intervals."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from objectflow.errors import DatasetError
from objectflow.evaluation.metrics.flow_metrics import FlowScore, PixelScore
from objectflow.evaluation.metrics.mover_metrics import MoverScore
from objectflow.evaluation.metrics.object_metrics import ObjectError
from objectflow.evaluation.metrics.pair_score import PairScore
from objectflow.evaluation.metrics.segmentation_metrics import PRF, SegmentationScore
from objectflow.evaluation.runtime import machine_name, summarise_runtime
from objectflow.evaluation.tables.bootstrap import Bootstrap
from objectflow.evaluation.tables.summary import summarise

NAN = math.nan


def rng() -> np.random.Generator:
    return np.random.default_rng(5)


def pixels(epe: float, aae: float, count: int, predicted: int, under: tuple[int, int, int]) -> PixelScore:
    return PixelScore(epe, aae, count, predicted, under)


def pair(number: int, epe: PixelScore, form: PRF, extracted: int, true: int, *errors: ObjectError) -> PairScore:
    segmentation = SegmentationScore(form, form, form, form, extracted, extracted, extracted, true, true, ())
    movers = MoverScore(2, 2, 1, static=number % 2 == 0)
    flow = FlowScore(epe, epe, epe)
    return PairScore(f"p{number}", f"s{number}", flow, segmentation, errors, float(number), movers=movers)


SCORES = [
    pair(1, pixels(1, 10, 10, 10, (5, 10, 10)), PRF(1, 0.5, 0.6), 1, 2, ObjectError(1, 0.9, 1, 1, True)),
    pair(2, pixels(4, 20, 30, 15, (0, 3, 9)), PRF(0.5, 0.1, 0.3), 0, 1, ObjectError(1, 0.9, 9, 3, True)),
    pair(3, pixels(NAN, NAN, 0, 0, (0, 0, 0)), PRF(0, 0, 0), 0, 0, ObjectError(1, 0.9, NAN, 1, True)),
]


def test_averages() -> None:
    got = summarise(SCORES, rng(), machine="test")
    assert (got.pairs, got.scenes) == (3, 3)
    # Flow: means over the two images with such pixels; the standard deviation is half the difference.
    assert (got.flow_masked.epe_cm.value, got.flow_masked.epe_std) == (2.5, 1.5)
    assert (got.flow_masked.aae_deg.value, got.flow_masked.aae_std) == (15, 5)
    assert got.flow_masked.images == 2
    # Pooled over 40 pixels: 5, 13 and 19 below 1, 5 and 10 cm, 25 predicted.
    assert [share.value for share in got.flow_all.under] == pytest.approx([5 / 40, 13 / 40, 19 / 40])
    assert got.flow_all.density.value == 25 / 40
    # Means over images: P = 1.5 / 3, R = 0.6 / 3. mean-F: 0.9 / 3; FBMS: 2 x 0.5 x 0.2 / 0.7.
    assert (got.mean_f.precision.value, got.mean_f.recall.value) == pytest.approx((0.5, 0.2))
    assert got.mean_f.f.value == pytest.approx(0.3)
    assert got.fbms.f.value == pytest.approx(0.2 / 0.7)
    assert got.overlap.f.value == got.boundary.f.value == pytest.approx(0.3)
    assert (got.mean_f.extracted, got.mean_f.true_objects) == (1, 3)
    assert got.mean_f.extracted_share.value == pytest.approx(1 / 3)
    # Rotations of 1 and 9 degrees (one is unknown), translations of 1, 3, 1 cm; the first and third are good.
    assert (got.objects.rotation_deg.value, got.objects.translation_cm.value) == (5, 1)
    assert got.objects.good.value == pytest.approx(2 / 3)
    assert got.objects.matched == 3
    # Seconds 2 and 3 remain after the warm-up.
    assert (got.runtime.median, got.runtime.pairs, got.runtime.machine) == (2.5, 2, "test")


def test_intervals_hold_the_value_and_repeat_with_the_seed() -> None:
    got = summarise(SCORES, rng(), machine="test")
    for interval in (got.flow_all.epe_cm, got.fbms.f, got.mean_f.f, got.flow_all.density, got.objects.rotation_deg):
        assert interval.low <= interval.value <= interval.high
    assert got == summarise(SCORES, rng(), machine="test")
    # Draws of two images with 1 and 4 cm and one without: both extremes are means of a single image.
    assert got.flow_all.epe_cm[1:] == (1, 4)


def test_pairs_of_one_scene_are_drawn_together() -> None:
    siblings = [replace(score, scene="s") for score in SCORES]
    got = summarise(siblings, rng(), machine="test")
    assert got.scenes == 1
    assert got.mean_f.f.low == got.mean_f.f.high == pytest.approx(got.mean_f.f.value)


def test_nothing_to_average() -> None:
    with pytest.raises(DatasetError, match="no pairs"):
        summarise([], rng())
    got = summarise([SCORES[2]], rng(), machine="test")
    assert math.isnan(got.flow_all.epe_cm.value)
    assert math.isnan(got.flow_all.epe_std)
    assert math.isnan(got.flow_all.density.value)
    assert math.isnan(got.mean_f.extracted_share.value)
    assert (got.fbms.f.value, got.runtime.median) == (0, 3)


def test_the_interval_of_a_mean_is_the_normal_one() -> None:
    # The mean of n = 400 values has the standard error s / 20, and the percentiles are 1.96 standard errors away.
    values = np.random.default_rng(1).normal(3.0, 2.0, size=400)
    got = Bootstrap([str(i) for i in range(400)], rng(), draws=4000).mean(values)
    error = values.std() / 20
    assert got.low == pytest.approx(values.mean() - 1.96 * error, abs=0.15 * error)
    assert got.high == pytest.approx(values.mean() + 1.96 * error, abs=0.15 * error)


@given(st.lists(st.tuples(st.integers(0, 4), st.floats(-5, 5)), min_size=1, max_size=12), st.integers(0, 1000))
def test_medians_are_those_of_the_resampled_values(owned: list[tuple[int, float]], seed: int) -> None:
    owners, values = [pair for pair, _ in owned], [value for _, value in owned]
    scenes = [f"s{i}" for i in range(5)]
    bootstrap = Bootstrap(scenes, np.random.default_rng(seed), draws=40)
    got = bootstrap.median(values, owners)
    medians = []
    for weights in np.concatenate(list(bootstrap.weights())):
        drawn = np.repeat(values, weights[owners].astype(int))
        if len(drawn):
            medians.append(np.median(drawn))
    assert got.value == pytest.approx(np.median(values))
    if medians:
        assert (got.low, got.high) == pytest.approx(tuple(np.quantile(medians, [0.025, 0.975])))


def test_runtime_of_one_pair_and_of_none() -> None:
    assert summarise_runtime([4.0]).median == 4
    assert summarise_runtime([9.0, 1.0, 2.0, 3.0], warm_up=1).median == 2
    assert math.isnan(summarise_runtime([]).median)


def test_the_machine_is_named() -> None:
    assert "core" in machine_name()
