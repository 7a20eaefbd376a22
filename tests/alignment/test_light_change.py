"""Changes of exposure, gamma and white balance, on frames transformed by a known law."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

import analytic
import objectflow
from objectflow import geometry
from objectflow.alignment.frame_pair import FramePair
from objectflow.alignment.light_change import LightChange, fit_light_change, in_current_light
from objectflow.frame import RgbdFrame
from objectflow.typing import Float64Array

CAMERA_MOTION = geometry.se3_exp([0.02, -0.01, 0.015, 0.01, 0.03, -0.02])


def relit(frame: RgbdFrame, gains: tuple[float, ...], gammas: tuple[float, ...]) -> RgbdFrame:
    """The frame under `gain * value ** gamma` of each channel, with values from 0 to 1."""
    value = np.asarray(gains) * (frame.color / 255.0) ** np.asarray(gammas)
    return dataclasses.replace(frame, color=np.rint(255 * value).clip(0, 255).astype(np.uint8))


@pytest.mark.parametrize(
    ("gains", "gammas"),
    [
        ((0.7, 0.7, 0.7), (1.0, 1.0, 1.0)),
        ((1.12, 1.0, 0.85), (0.7, 0.7, 0.7)),
        ((0.8, 0.9, 1.0), (1.3, 1.2, 1.1)),
    ],
    ids=["exposure", "gamma and white balance", "each channel"],
)
@pytest.mark.parametrize("motion", [None, CAMERA_MOTION], ids=["static", "moving"])
def test_gain_and_gamma_are_recovered(
    gains: tuple[float, ...], gammas: tuple[float, ...], motion: Float64Array | None
) -> None:
    """Within 3%, with objects that move and a camera that stands still or moves."""
    scene = analytic.make_scene(5, objects=(2, 3), camera_motion=motion, depth_noise=0.001)
    found = fit_light_change(FramePair(scene.prev, relit(scene.curr, gains, gammas)), motion)
    assert found is not None
    np.testing.assert_allclose(found.gains, gains, rtol=0.03)
    np.testing.assert_allclose(found.gammas, gammas, rtol=0.03)


def test_the_previous_frame_is_brought_into_the_current_light() -> None:
    scene = analytic.make_scene(5, moving_share=0.0)
    gains, gammas = (1.1, 1.0, 0.9), (0.8, 0.8, 0.8)
    pair = FramePair(scene.prev, relit(scene.curr, gains, gammas))
    equal = in_current_light(pair, LightChange(gains, gammas))
    assert np.abs(equal.prev.frame.color.astype(int) - equal.curr.frame.color).max() <= 1
    assert equal.curr is pair.curr
    assert equal.prev.frame.depth is scene.prev.depth


def test_equal_light_and_a_moving_shadow_are_no_change_of_the_light() -> None:
    """Half of the image darkens by half: no change of the whole image explains that."""
    scene = analytic.make_scene(5)
    assert fit_light_change(FramePair(scene.prev, scene.curr)) is None
    shaded = scene.curr.color.copy()
    shaded[:, 130:] //= 2
    shaded[:, :60] = np.minimum(2 * shaded[:, :60].astype(int), 255)
    assert fit_light_change(FramePair(scene.prev, dataclasses.replace(scene.curr, color=shaded))) is None


def test_frames_without_common_depth_have_no_change_of_light() -> None:
    scene = analytic.make_scene(5)
    farther = dataclasses.replace(relit(scene.curr, (0.7,) * 3, (1.0,) * 3), depth=scene.curr.depth * 1.2)
    assert fit_light_change(FramePair(scene.prev, farther)) is None


def test_a_still_scene_under_changed_light_has_no_movers_and_a_note() -> None:
    scene = analytic.make_scene(5, moving_share=0.0, depth_noise=0.001)
    curr = relit(scene.curr, (1.12, 1.0, 0.85), (0.7, 0.7, 0.7))
    motion = objectflow.load("consensus")(scene.prev, curr)
    assert motion.moving == ()
    assert motion.camera == "static"
    (note,) = motion.notes
    assert note.startswith("light: exposure or white balance changed (gain 1.1")
