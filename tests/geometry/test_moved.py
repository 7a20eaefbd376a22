"""The rule by which a rigid motion counts as moving: by hand, at its bounds, and for batches."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from objectflow.geometry import Camera, make_transform
from objectflow.geometry.moved import LEVER_ARM, STATIC_DISPLACEMENT, displaces, exceeds_noise, is_moving


@pytest.mark.parametrize(("metres", "moving"), [(0.0, False), (0.0039, False), (0.0041, True), (1.0, True)])
def test_a_translation_counts_above_the_tolerance(metres: float, moving: bool) -> None:
    for direction in ([1, 0, 0], [0, -1, 0], [0.6, 0, 0.8]):
        assert bool(is_moving(np.eye(3), metres * np.array(direction))) is moving


@pytest.mark.parametrize(("displacement", "moving"), [(0.0039, False), (0.0041, True)])
@pytest.mark.parametrize("lever_arm", [LEVER_ARM, 0.2])
def test_a_rotation_counts_by_the_arc_of_its_lever_arm(displacement: float, lever_arm: float, moving: bool) -> None:
    angle = displacement / lever_arm
    R = Rotation.from_rotvec(angle * np.array([0.6, 0.0, 0.8])).as_matrix()
    assert bool(is_moving(R, np.zeros(3), lever_arm=lever_arm)) is moving


def test_the_tolerance_itself_is_no_motion() -> None:
    shift = np.array([0.0, 0.0, 0.004])
    assert STATIC_DISPLACEMENT == 0.004
    assert not is_moving(np.eye(3), shift)
    assert not is_moving(np.eye(3), 10 * shift, 0.04)
    assert is_moving(np.eye(3), shift, 0.0039)
    assert is_moving(np.eye(3), shift, 0.0)
    assert not is_moving(np.eye(3), np.zeros(3), 0.0)


def test_translation_and_rotation_are_tested_separately() -> None:
    """Two displacements just below the tolerance do not add up."""
    R = Rotation.from_rotvec([0.0039 / LEVER_ARM, 0, 0]).as_matrix()
    assert not is_moving(R, np.array([0.0039, 0, 0]))


def test_batches() -> None:
    rotations = Rotation.from_rotvec([[0, 0, 0], [0, 0, 0], [0, 0.1, 0], [0, 0, np.pi]]).as_matrix()
    shifts = np.array([[0, 0, 0], [0, 0.01, 0], [0, 0, 0], [0, 0, 0]])
    expected = [False, True, True, True]
    assert is_moving(rotations, shifts).tolist() == expected
    nested = is_moving(rotations.reshape(2, 2, 3, 3), shifts.reshape(2, 2, 3))
    assert nested.shape == (2, 2)
    assert nested.dtype == np.bool_
    assert nested.ravel().tolist() == expected


@pytest.mark.parametrize(
    ("shift", "exceeds"),
    [
        ((0.0013, 0, 0), False),  # 0.65 pixels at 1 m, 0.7 standard deviations of depth
        ((0.0015, 0, 0), True),  # 0.75 pixels
        ((0, 0, 0.0056), False),  # 2.97 standard deviations along the optical axis
        ((0, 0, 0.0058), True),  # 3.07
    ],
)
def test_a_cameras_motion_exceeds_noise_in_pixels_or_in_depth(shift: tuple[float, ...], exceeds: bool) -> None:
    """At 1 m, a pixel of this camera is 2 mm, and the depth of a structured-light camera is off by 1.884 mm."""
    camera = Camera(64, 48, 500.0, 500.0, 31.5, 23.5)
    points = np.array([[0.0, 0, 1], [0.01, 0, 1], [-0.01, 0.01, 1]])
    motion = make_transform(np.eye(3), shift)
    assert exceeds_noise(motion, points, camera) is exceeds
    assert not exceeds_noise(motion, points, camera, shift_px=1.0, sigmas=4.0)
    assert exceeds_noise(motion, points, camera, shift_px=0.0)
    assert not exceeds_noise(motion, points[:0], camera)


ROD = np.c_[np.linspace(-0.2, 0.2, 101), np.zeros(101), np.full(101, 1.0)]
"""Points of a rod of 40 cm along x, a metre away."""


@pytest.mark.parametrize(("degrees", "moving"), [(1.2, False), (1.3, True)])
def test_a_rod_moves_by_its_ends(degrees: float, moving: bool) -> None:
    """The outer tenth lies 18 cm or more from its middle: 4 mm are 1.273 degrees there, and 4.6 at 5 cm."""
    center = np.array([0.0, 0.0, 1.0])
    R = Rotation.from_rotvec([0, 0, np.radians(degrees)]).as_matrix()
    motion = make_transform(R, center - R @ center)
    assert not is_moving(R, np.zeros(3))
    assert displaces(motion, ROD, center) is moving
    assert not displaces(motion, ROD[45:56], center)
    assert not displaces(motion, ROD[:0], center)


def test_a_shift_and_a_turn_add_up_at_the_ends() -> None:
    center = np.array([0.0, 0.0, 1.0])
    R = Rotation.from_rotvec([0, 0, np.radians(1.0)]).as_matrix()
    both = make_transform(R, center - R @ center + [0.0, 0.003, 0.0])
    assert displaces(both, ROD, center)
    assert not displaces(make_transform(np.eye(3), [0.0, 0.003, 0.0]), ROD, center)
    assert not displaces(make_transform(R, center - R @ center), ROD, center)


def test_a_centre_that_moves_far_is_enough() -> None:
    assert displaces(make_transform(np.eye(3), [0.005, 0, 0]), ROD[:0], np.zeros(3))
