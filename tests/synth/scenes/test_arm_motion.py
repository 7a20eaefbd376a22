"""Arms that hold, approach and release objects, move freely, or rest: against closed forms."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from objectflow import geometry
from objectflow.synth.objects.arms import build_arm
from objectflow.synth.scenes.actions import Action
from objectflow.synth.scenes.arm_motion import ArmPlan, arm_poses, draw_arm_plan, minimum_jerk
from objectflow.typing import Float64Array

ARM = build_arm(0)
CARRY = Action("carry", 0, 20, 30, heading=0.3, path=0.2, speed=0.0, angle=0.8, rise=0.1)
PLAN = ArmPlan(
    action=CARRY, azimuth=0.5, pitch=0.6, roll=0.2, depth=0.5, reach=0.15, approach=20, release=0,
    twist=(0.0, 0.0, 0.0), begin=(0.1, 0.0, 0.05), end=(-0.1, 0.1, 0.02), start=5, frames=40,
)  # fmt: skip
CORNERS = np.array([[x, y, z] for x in (-0.04, 0.04) for y in (-0.03, 0.03) for z in (-0.1, 0.1)])


def carried(frames: int = 80) -> Float64Array:
    """(frames, 4, 4): a box that stands at (0.1, 0, 0.1) until frame 20 and is then carried and turned."""
    share = minimum_jerk((np.arange(frames) - CARRY.start) / CARRY.frames)
    rotations = np.stack([geometry.so3_exp(np.array([0, 0, CARRY.angle * s])) for s in share])
    positions = np.array([0.1, 0.0, 0.1]) + share[:, None] * (CARRY.path * CARRY.direction + [0, 0, CARRY.rise])
    return geometry.make_transform(rotations, positions)


def test_minimum_jerk_starts_and_ends_at_rest() -> None:
    np.testing.assert_allclose(minimum_jerk(np.array([-1.0, 0.0, 0.5, 1.0, 3.0])), [0, 0, 0.5, 1, 1])
    near = minimum_jerk(np.array([0.001, 0.999]))
    np.testing.assert_allclose(near, [0, 1], atol=1e-7)


def test_a_hand_without_twist_moves_with_the_object_that_it_holds() -> None:
    held = carried()
    poses = arm_poses(PLAN, ARM, held, CORNERS, 80)
    object_T_arm = geometry.inverse(held[20:]) @ poses[20:]
    np.testing.assert_allclose(object_T_arm, np.broadcast_to(object_T_arm[0], object_T_arm.shape), atol=1e-9)
    grip = poses[20, :3, :3] @ ARM.grip + poses[20, :3, 3]
    assert np.abs(grip - held[20, :3, 3]).max() < 0.13  # at the box, whose longest half side is 0.1 m


def test_the_hand_approaches_along_the_forearm_and_retreats() -> None:
    held = carried()
    poses = arm_poses(dataclasses.replace(PLAN, release=15), ARM, held, CORNERS, 80)
    c, s = math.cos(PLAN.pitch), math.sin(PLAN.pitch)
    forward = np.array([-c * math.cos(PLAN.azimuth), -c * math.sin(PLAN.azimuth), -s])
    np.testing.assert_allclose(poses[20, :3, 0], forward, atol=1e-12)
    np.testing.assert_allclose(poses[0, :3, 3], poses[20, :3, 3] - PLAN.reach * forward, atol=1e-9)
    np.testing.assert_allclose(poses[70, :3, 3], poses[50, :3, 3] - PLAN.reach * forward, atol=1e-9)
    np.testing.assert_array_equal(poses[66:], np.broadcast_to(poses[66], poses[66:].shape))


def test_a_twist_turns_the_hand_about_its_grip() -> None:
    held = np.broadcast_to(carried()[0], (80, 4, 4))
    turned = arm_poses(dataclasses.replace(PLAN, twist=(0.0, 0.0, 0.4)), ARM, held, CORNERS, 80)
    grips = turned[20:, :3, :3] @ ARM.grip + turned[20:, :3, 3]
    np.testing.assert_allclose(grips, np.broadcast_to(grips[0], grips.shape), atol=1e-9)
    R = turned[60, :3, :3] @ turned[20, :3, :3].T
    assert float(np.linalg.norm(geometry.so3_log(R))) == pytest.approx(0.4)


def test_a_free_hand_moves_between_its_places_above_the_table() -> None:
    poses = arm_poses(dataclasses.replace(PLAN, action=None), ARM, None, None, 80)
    grips = poses[:, :3, :3] @ ARM.grip + poses[:, :3, 3]
    np.testing.assert_allclose((grips[-1] - grips[0]), np.subtract(PLAN.end, PLAN.begin), atol=1e-9)
    np.testing.assert_array_equal(poses[45:], np.broadcast_to(poses[45], poses[45:].shape))
    hand = ARM.model.vertices[ARM.model.vertices[:, 0] > -0.1]
    for pose in poses:
        assert (hand @ pose[:3, :3].T + pose[:3, 3])[:, 2].min() > 0


def test_a_resting_hand_does_not_move() -> None:
    plan = draw_arm_plan(np.random.default_rng(0), None, 0.0, 0.3, True)
    poses = arm_poses(plan, ARM, None, None, 40)
    np.testing.assert_array_equal(poses, np.broadcast_to(poses[0], poses.shape))
