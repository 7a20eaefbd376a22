"""The similarity of aligned colours: closed forms, another library, and cards whose motions are known in pixels."""

from __future__ import annotations

import numpy as np
import pytest

from helpers.flat_scenes import CAMERA, Card, draw
from objectflow import geometry
from objectflow.alignment.frame_pair import FramePair
from objectflow.frame import RgbdFrame
from objectflow.geometry.camera import Camera
from objectflow.methods.postprocess.color_similarity import color_similarity, structural_similarity
from objectflow.methods.postprocess.pair_likelihood import PairLikelihood
from objectflow.methods.postprocess.settings import ColorSimilaritySettings, PostprocessSettings

DEFAULTS = PostprocessSettings()
CARD, BEFORE = Card(1, 60, 40, 40, 30, 0.8), Card(1, 50, 40, 40, 30, 0.8)


def test_structural_similarity_in_numbers() -> None:
    rng = np.random.default_rng(0)
    a = rng.normal(0, 10, 4000).astype(np.float32)
    noise = 3.0
    v = float(a.var())
    assert structural_similarity([(a, a + 50)], noise) == pytest.approx(1, abs=1e-5)  # means do not count
    assert structural_similarity([(a, -a)], noise) == pytest.approx((9 - 2 * v) / (9 + 2 * v), abs=1e-5)
    assert structural_similarity([(a, np.zeros_like(a))], noise) == pytest.approx(9 / (9 + v), abs=1e-5)
    assert structural_similarity([(np.zeros_like(a), np.ones_like(a))], noise) == 1  # no colour contradicts
    # The contrast and structure of two channels at once are those of their sums.
    two = structural_similarity([(a, a), (a, -a)], noise)
    assert two == pytest.approx(9 / (9 + 4 * v), abs=1e-5)


def test_structural_similarity_without_noise_is_the_correlation_of_equally_varied_values() -> None:
    rng = np.random.default_rng(1)
    a, b = rng.normal(size=(2, 500))
    a, b = (a - a.mean()) / a.std(), (b - b.mean()) / b.std()
    b = 0.6 * a + 0.8 * b
    a, b = (((x - x.mean()) / x.std()).astype(np.float32) for x in (a, b))
    assert structural_similarity([(a, b)], 1e-9) == pytest.approx(np.corrcoef(a, b)[0, 1], abs=1e-5)


def similarity(prev: RgbdFrame, curr: RgbdFrame, columns: int) -> float:
    """Of the card, under a motion by some pixels to the right."""
    likelihood = PairLikelihood.of(FramePair(prev, curr), DEFAULTS.likelihood)
    return color_similarity(likelihood, CARD.mask, CARD.motion(columns), DEFAULTS.color_similarity)


def test_the_true_motion_aligns_the_colours_of_a_card() -> None:
    prev, curr = draw(BEFORE), draw(CARD)
    assert similarity(prev, curr, 10) > 0.97
    assert similarity(prev, curr, 4) < 0.5  # the depth fits as well, but the colours lie elsewhere


def test_an_object_may_fill_the_image() -> None:
    """76,800 pixels, more than OpenCV samples at once."""
    rng = np.random.default_rng(2)
    color = np.kron(rng.integers(0, 255, (60, 80, 3)), np.ones((4, 4, 1))).astype(np.uint8)
    depth, camera = np.full((240, 320), 0.8, np.float32), Camera(320, 240, 260.0, 260.0, 159.5, 119.5)
    frames = [RgbdFrame(np.roll(color, shift, axis=1), depth, camera) for shift in (0, 3)]
    likelihood = PairLikelihood.of(FramePair(*frames), DEFAULTS.likelihood)
    everything = np.ones(depth.shape, bool)
    shift = geometry.make_transform(np.eye(3), [-3 * 0.8 / 260, 0.0, 0.0])
    assert color_similarity(likelihood, everything, shift, DEFAULTS.color_similarity) > 0.95
    assert color_similarity(likelihood, everything, np.eye(4), DEFAULTS.color_similarity) < 0.6


def test_a_shadow_hides_no_hue() -> None:
    """Half of the card has half the light: lightness varies otherwise, hue does not."""
    prev, curr = draw(BEFORE), draw(CARD)
    dark = prev.color.copy()
    dark[40:55, 50:90] = dark[40:55, 50:90] // 2
    assert similarity(RgbdFrame(dark, prev.depth, CAMERA), curr, 10) > 0.7


def test_plain_cards_contradict_no_motion() -> None:
    frames = []
    for card in (BEFORE, CARD):
        frame = draw(card)
        color = frame.color.copy()
        color[card.mask] = (120, 130, 140)
        frames.append(RgbdFrame(color, frame.depth, CAMERA))
    assert similarity(*frames, 10) == pytest.approx(1, abs=0.02)


def test_nothing_is_confirmed_where_the_depth_does_not_fit() -> None:
    prev, curr = draw(BEFORE), draw(CARD)
    likelihood = PairLikelihood.of(FramePair(prev, curr), DEFAULTS.likelihood)
    near = geometry.make_transform(np.eye(3), [0.0, 0.0, -0.1]) @ CARD.motion(10)
    assert color_similarity(likelihood, CARD.mask, near, ColorSimilaritySettings()) == 0.0


def test_depth_cost_by_closed_form() -> None:
    """Half the square of the difference in standard deviations; infinite behind the surface and outside the image."""
    pair = FramePair(draw(BEFORE), draw(CARD))
    likelihood, settings = PairLikelihood.of(pair, DEFAULTS.likelihood), DEFAULTS.likelihood
    inner = CARD.mask.copy()
    inner[:, :64] = inner[:, 96:] = inner[:44] = inner[66:] = False
    off = 0.002
    sigma = settings.noise_factor * float(pair.noise.sigma(np.float32(0.8 - off))) + settings.extra_noise
    moved = geometry.make_transform(np.eye(3), [0.0, 0.0, -off]) @ CARD.motion(10)
    cost = likelihood.depth_cost(moved, inner)
    assert cost == pytest.approx(0.5 * (off / sigma) ** 2, rel=0.01)
    behind = geometry.make_transform(np.eye(3), [0.0, 0.0, 0.1]) @ CARD.motion(10)
    assert np.isinf(likelihood.depth_cost(behind, inner)).all()
    assert np.isinf(likelihood.depth_cost(CARD.motion(150), inner)).all()
