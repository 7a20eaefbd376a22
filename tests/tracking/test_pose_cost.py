"""Costs of poses on a textured and on a plain plate before noise, whose true poses are known."""

from __future__ import annotations

import numpy as np
import pytest

from objectflow import geometry
from objectflow.alignment.registration import (
    RegistrationSettings,
    RegistrationSource,
    RegistrationSources,
    RegistrationTarget,
    refine,
)
from objectflow.frame import RgbdFrame
from objectflow.geometry.camera import Camera
from objectflow.tracking.pose_cost import Chroma, PoseCostSettings, is_better, pose_costs
from objectflow.typing import BoolMask, Float64Array

CAMERA = Camera(160, 120, 150.0, 150.0, 79.5, 59.5)
MIDDLE = np.zeros((120, 160), bool)
MIDDLE[45:75, 65:95] = True
SETTINGS, REGISTRATION = PoseCostSettings(), RegistrationSettings()


def plate(seed: int, *, texture: bool) -> tuple[RgbdFrame, BoolMask]:
    """A plate of 40 x 40 cm at 1 m before a wall at 2 m, with the noise of structured light."""
    v, u = np.mgrid[0:120, 0:160]
    mask = (np.abs(u - 79.5) < 30) & (np.abs(v - 59.5) < 30)
    depth = np.where(mask, 1.0, 2.0) + 0.0019 * np.random.default_rng(seed).standard_normal(mask.shape)
    color = np.full((120, 160, 3), 120, np.uint8)
    if texture:
        color[mask] = (120 + 60 * np.sin(u / 3) * np.sin(v / 4))[mask][:, None]
    return RgbdFrame(color, depth.astype(np.float32), CAMERA), mask


def costs(texture: bool, *poses: Float64Array) -> Float64Array:
    """The costs of the middle of the plate, which at no pose reaches the plate's edge."""
    (prev, _), (curr, _) = plate(0, texture=texture), plate(1, texture=texture)
    source = RegistrationSources(curr).take(MIDDLE)
    return pose_costs(RegistrationTarget(prev), source, poses, REGISTRATION, SETTINGS)


def shifted(x: float, z: float = 0.0) -> Float64Array:
    return geometry.make_transform(np.eye(3), [x, 0.0, z])


def test_the_cost_of_the_true_pose_is_that_of_the_noise() -> None:
    """Both depths vary by one standard deviation, so that the mean squared difference is 2; grey levels are exact."""
    true, off = costs(True, np.eye(4), shifted(0, 0.006))
    assert true == pytest.approx(2.0, rel=0.15)
    # 6 mm are 3.2 standard deviations.
    assert off == pytest.approx(2 + 3.2**2, rel=0.15)
    assert is_better(np.array([off, true]), SETTINGS)
    assert not is_better(np.array([true, off]), SETTINGS)


def test_texture_tells_poses_apart_that_depth_does_not() -> None:
    true, off = costs(True, np.eye(4), shifted(0.01))
    assert is_better(np.array([off, true]), SETTINGS)
    true, off = costs(False, np.eye(4), shifted(0.01))
    assert not is_better(np.array([off, true]), SETTINGS)


def test_hue_tells_poses_apart_that_grey_levels_do_not() -> None:
    """A red patch on a green plate of the same grey level, at its place and 4 cm beside it."""
    (prev, _), (curr, _) = plate(0, texture=False), plate(1, texture=False)
    source = RegistrationSources(curr).take(MIDDLE)
    image = np.full((120, 160, 2), (-40.0, 30.0), np.float32)
    image[MIDDLE] = 40.0, 30.0
    colors = Chroma(image, np.full((len(source.points), 2), (40.0, 30.0), np.float32))
    poses = np.eye(4), shifted(0.04)
    target = RegistrationTarget(prev)
    gray = pose_costs(target, source, poses, REGISTRATION, SETTINGS)
    true, off = pose_costs(target, source, poses, REGISTRATION, SETTINGS, colors)
    assert not is_better(gray[::-1], SETTINGS)
    assert true == pytest.approx(gray[0])
    # 6 of 30 columns lie on green, 80 units off; the residual is truncated.
    beside = 6 / 30 * REGISTRATION.color_weight * SETTINGS.max_sigmas**2
    assert off - gray[1] == pytest.approx(beside, rel=0.1)


def test_a_plate_without_texture_does_not_slide() -> None:
    """Registration moves the plate along itself; neither depth nor colour supports that."""
    (prev, _), (curr, _) = plate(0, texture=False), plate(1, texture=False)
    target, source = RegistrationTarget(prev), RegistrationSources(curr).take(MIDDLE)
    start = shifted(0.004)
    found = refine(target, source, start, settings=REGISTRATION).prev_T_curr
    assert not is_better(pose_costs(target, source, (start, found), REGISTRATION, SETTINGS), SETTINGS)


def test_hidden_points_do_not_count_and_no_point_costs_nothing() -> None:
    (prev, _), (curr, mask) = plate(0, texture=True), plate(1, texture=True)
    depth = prev.depth.copy()
    depth[:, :80] = 0.5
    hidden = RegistrationTarget(RgbdFrame(prev.color, depth, CAMERA))
    source = RegistrationSources(curr).take(mask)
    (cost,) = pose_costs(hidden, source, (np.eye(4),), REGISTRATION, SETTINGS)
    assert cost == pytest.approx(2.0, rel=0.2)
    behind = geometry.make_transform(np.diag([1.0, -1.0, -1.0]), [0.0, 0.0, 0.0])
    nothing = RegistrationSource(np.zeros((0, 3), np.float32), (np.zeros(0, np.float32),) * 2)
    for points, pose in ((source, behind), (nothing, np.eye(4))):
        assert pose_costs(hidden, points, (pose,), REGISTRATION, SETTINGS).tolist() == [0.0]
