"""End-point and angular errors of flows small enough to compute by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from objectflow.errors import ResultError
from objectflow.evaluation.metrics.flow_metrics import FlowScore, angular_errors, score_flow
from objectflow.typing import BoolMask, Float32Array

flows = arrays(np.float32, (3, 4, 3), elements=st.floats(-2, 2, width=32))
masks = arrays(np.bool_, (3, 4))
ALL = np.ones((1, 4), np.bool_)


def flow(*pixels: tuple[float, float, float]) -> Float32Array:
    return np.array([pixels], np.float32)


NAN = (math.nan, math.nan, math.nan)


def test_errors_of_four_pixels() -> None:
    true = flow((0, 0, 0), (0, 0, 1), (0.02, 0, 0), (0, 0, 0))
    guess = flow((1, 0, 0), (1, 0, 0), (0.02, 0.03, 0.04), (0, 0, 0))
    masked = np.array([[False, False, True, True]])
    moving = np.array([[False, False, True, False]])
    score = score_flow(guess, true, masked, moving)
    # EPE: 1 m, sqrt(2) m, sqrt(0.03^2 + 0.04^2) = 0.05 m, 0.
    assert score.all.epe_cm == pytest.approx((100 + 100 * math.sqrt(2) + 5 + 0) / 4, rel=1e-6)
    assert score.masked.epe_cm == pytest.approx(2.5, rel=1e-6)
    assert score.moving.epe_cm == pytest.approx(5, rel=1e-6)
    # AAE: (0,0,0,1) and (1,0,0,1): 45 degrees. (0,0,1,1) and (1,0,0,1): cosine 1/2, 60 degrees.
    # (0.02,0,0,1) and (0.02,0.03,0.04,1): cosine (0.0004 + 1) / (sqrt(1.0004) sqrt(1.0029)).
    third = math.degrees(math.acos(1.0004 / math.sqrt(1.0004 * 1.0029)))
    assert score.all.aae_deg == pytest.approx((45 + 60 + third + 0) / 4, rel=1e-6)
    assert score.moving.aae_deg == pytest.approx(third, rel=1e-6)
    # The limits of 1 and 10 cm; the third pixel's error equals 5 cm up to rounding.
    assert score.all.under[0] == 1
    assert score.all.under[2] == 2
    assert (score.all.pixels, score.masked.pixels, score.moving.pixels) == (4, 2, 1)


def test_shares_count_below_each_limit() -> None:
    true = flow(*[(0, 0, 0)] * 4)
    guess = flow((0.009, 0, 0), (0, 0.04, 0), (0, 0, 0.09), (0.2, 0, 0))
    assert score_flow(guess, true, ALL, ALL).masked.under == (1, 2, 3)


def test_small_angles_keep_their_digits() -> None:
    # At tan = 1e-6, the error of an arccosine in double precision exceeds a tenth of a percent.
    angle = angular_errors(np.array([[1e-6], [0.0], [0.0]]), np.zeros((3, 1)))
    assert angle[0] == pytest.approx(math.degrees(1e-6), rel=1e-9)


def test_a_sparse_prediction_is_scored_where_it_is() -> None:
    true = flow((0, 0, 0), (0, 0, 0), NAN, (0, 0, 0))
    guess = flow((0.02, 0, 0), NAN, (1, 1, 1), (math.inf, 0, 0))
    score = score_flow(guess, true, ALL, ALL)
    # Three pixels have truth, one of them a finite prediction; the others count as misses in the shares.
    assert (score.all.pixels, score.all.predicted, score.all.under) == (3, 1, (0, 1, 1))
    assert score.all.epe_cm == pytest.approx(2, rel=1e-6)


def test_without_pixels_there_is_no_error() -> None:
    zero = flow(*[(0, 0, 0)] * 4)
    score = score_flow(zero, zero, ~ALL, ~ALL)
    assert math.isnan(score.masked.epe_cm)
    assert math.isnan(score.masked.aae_deg)
    assert (score.masked.pixels, score.masked.under) == (0, (0, 0, 0))
    assert score.all.epe_cm == 0


def test_shapes_that_do_not_fit() -> None:
    zero = flow(*[(0, 0, 0)] * 4)
    with pytest.raises(ResultError, match="does not fit"):
        score_flow(zero[:, :3], zero, ALL, ALL)
    with pytest.raises(ResultError, match="masks"):
        score_flow(zero, zero, ALL[:, :2], ALL)


def plain(guess: Float32Array, true: Float32Array, mask: BoolMask) -> tuple[float, float]:
    """The definition, pixel by pixel."""
    epe, aae = [], []
    for p, t in zip(guess[mask].tolist(), true[mask].tolist(), strict=True):
        epe.append(100 * math.dist(p, t))
        a, b = [*p, 1.0], [*t, 1.0]
        cosine = sum(x * y for x, y in zip(a, b, strict=True)) / math.hypot(*a) / math.hypot(*b)
        aae.append(math.degrees(math.acos(max(-1.0, min(1.0, cosine)))))
    return sum(epe) / len(epe), sum(aae) / len(aae)


@given(flows, flows, masks)
def test_against_the_definition(guess: Float32Array, true: Float32Array, mask: BoolMask) -> None:
    score = score_flow(guess, true, mask, mask)
    assert (score.all.epe_cm, score.all.aae_deg) == pytest.approx(
        plain(guess, true, np.ones((3, 4), np.bool_)), abs=1e-5
    )
    if mask.any():
        assert (score.masked.epe_cm, score.masked.aae_deg) == pytest.approx(plain(guess, true, mask), abs=1e-5)


@given(flows, masks)
def test_the_truth_scores_zero(true: Float32Array, mask: BoolMask) -> None:
    score = score_flow(true.copy(), true, mask, mask)
    assert (score.all.epe_cm, score.all.aae_deg) == (0, 0)
    assert score.masked.under == (mask.sum(),) * 3


@given(flows, flows, masks)
def test_both_errors_are_symmetric(a: Float32Array, b: Float32Array, mask: BoolMask) -> None:
    def errors(score: FlowScore) -> tuple[float, float]:
        return score.all.epe_cm, score.all.aae_deg

    assert errors(score_flow(a, b, mask, mask)) == pytest.approx(errors(score_flow(b, a, mask, mask)))
