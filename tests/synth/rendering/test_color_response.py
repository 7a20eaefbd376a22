"""The response of a camera: closed forms of exposure, gamma, white balance and saturation."""

from __future__ import annotations

import numpy as np
import pytest

from objectflow.synth.rendering.color_response import ColorResponse, ResponseSettings, draw_responses

RAMP = np.repeat(np.arange(256, dtype=np.uint8)[None, :, None], 3, axis=2)


def test_the_identity_changes_nothing() -> None:
    same = ColorResponse(np.ones(3), 1.0, 1.0)
    np.testing.assert_array_equal(same.apply(RAMP), RAMP)


def test_a_stop_doubles_linear_light_and_white_saturates() -> None:
    brighter = ColorResponse(np.full(3, 2.0), 1.0, 1.0).apply(RAMP)
    assert brighter[0, 100, 0] == round(100 * 2 ** (1 / 2.2))
    assert (brighter[0, 200:] == 255).all()


def test_gamma_keeps_black_and_white_and_balance_changes_one_channel() -> None:
    curved = ColorResponse(np.ones(3), 1.2, 1.0).apply(RAMP)
    assert curved[0, 128, 1] == round(255 * (128 / 255) ** 1.2)
    assert (curved[0, 0] == 0).all()
    assert (curved[0, 255] == 255).all()
    red = ColorResponse(np.array([1.1, 1.0, 1.0]), 1.0, 1.0).apply(RAMP)
    assert red[0, 100, 0] == round(100 * 1.1 ** (1 / 2.2))
    np.testing.assert_array_equal(red[..., 1:], RAMP[..., 1:])


def test_without_saturation_all_channels_are_equal() -> None:
    color = np.array([[[200, 100, 30]]], dtype=np.uint8)
    grey = ColorResponse(np.ones(3), 1.0, 0.0).apply(color)
    assert len(np.unique(grey)) == 1


def test_the_share_of_steady_pairs_and_the_spread_of_the_changes() -> None:
    settings = ResponseSettings()
    rng = np.random.default_rng(0)
    pairs = [draw_responses(rng, settings) for _ in range(3000)]
    changes = np.array([np.log2(b.gain[1] / a.gain[1]) for a, b in pairs])
    assert float((changes == 0).mean()) == pytest.approx(settings.steady, abs=0.03)
    assert float(changes[changes != 0].std()) == pytest.approx(settings.exposure_change, rel=0.06)
    assert float(np.log2([a.gain[1] for a, _ in pairs]).std()) == pytest.approx(settings.exposure, rel=0.06)
