"""The running estimate of depth noise, on walls with normally distributed noise of known size."""

from __future__ import annotations

import pickle

import numpy as np
import pytest

from objectflow.alignment.frame_pair import FramePair
from objectflow.frame import RgbdFrame
from objectflow.geometry.camera import Camera
from objectflow.geometry.depth_noise import STRUCTURED_LIGHT
from objectflow.motion import SceneMotion
from objectflow.tracking.running_noise import RunningNoise

CAMERA = Camera(160, 120, 150.0, 150.0, 79.5, 59.5)
COLOR = np.random.default_rng(0).integers(0, 255, (120, 160, 3), dtype=np.uint8)
STILL = SceneMotion(np.zeros((120, 160), np.int32), np.zeros((120, 160, 3), np.float32))
NEAR, FAR = 0.008, 0.03
"""Metres: noise of the walls at 1 m, on the left, and at 2 m, on the right."""


def walls(seed: int, shift: float = 0.0) -> RgbdFrame:
    depth = np.full((120, 160), 1.0 + shift)
    depth[:, 80:] = 2.0 + shift
    sigma = np.where(depth < 1.5, NEAR, FAR)
    noise = sigma * np.random.default_rng(seed).standard_normal(depth.shape)
    return RgbdFrame(COLOR, (depth + noise).astype(np.float32), CAMERA)


def test_the_noise_of_the_camera_is_found_at_each_depth() -> None:
    noise = RunningNoise(pairs=10)
    assert noise.noise == STRUCTURED_LIGHT
    found = [noise.add(FramePair(walls(k), walls(k + 1)), STILL) for k in range(12)][-1]
    assert found.sigma(1.0) == pytest.approx(NEAR, rel=0.1)
    assert found.sigma(2.0) == pytest.approx(FAR, rel=0.1)
    assert STRUCTURED_LIGHT.sigma(2.0) < 0.007


def test_a_pair_in_which_everything_moves_hardly_changes_the_estimate() -> None:
    noise = RunningNoise(pairs=10)
    for k in range(8):
        noise.add(FramePair(walls(k), walls(k + 1)), STILL)
    # An estimator that takes a board before the camera for the background reports no motion of the camera.
    disturbed = FramePair(walls(8), walls(9, shift=0.07))
    alone = RunningNoise(pairs=10).add(disturbed, STILL)
    assert alone.sigma(1.0) > 3 * NEAR
    assert noise.add(disturbed, STILL).sigma(1.0) == pytest.approx(NEAR, rel=0.15)


def test_a_pair_with_an_unknown_camera_is_left_out() -> None:
    lost = SceneMotion(STILL.labels, STILL.scene_flow * np.nan, camera_known=False)
    assert RunningNoise(pairs=10).add(FramePair(walls(0), walls(1)), lost) == STRUCTURED_LIGHT


def test_the_state_can_be_pickled_and_does_not_grow() -> None:
    noise = RunningNoise(pairs=5)
    sizes = []
    for k in range(15):
        noise.add(FramePair(walls(k), walls(k + 1)), STILL)
        sizes.append(len(pickle.dumps(noise)))
    assert sizes[-1] == sizes[5]
    again = pickle.loads(pickle.dumps(noise))
    pair = FramePair(walls(20), walls(21))
    assert again.add(pair, STILL) == noise.add(pair, STILL)
