"""Motions of arms: a hand that approaches, moves and releases an object, moves freely, or rests."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from objectflow import geometry
from objectflow.synth.objects.arms import Arm
from objectflow.synth.scenes.actions import Action
from objectflow.typing import Float64Array

HAND_REACH = 0.1
"""Distance behind the palm, metres, up to which an arm counts as its hand and stays above the table."""
HELD_KINDS = ("slide", "turn", "lift", "carry")
"""Kinds of actions that a hand can carry out."""
Point = tuple[float, float, float]


@dataclass(frozen=True)
class ArmPlan:
    """How an arm moves.

    Attributes:
        action: the action that the hand carries out, or None for a hand that holds nothing.
        azimuth: direction from which the arm reaches over the table, radians.
        pitch: angle at which the forearm points downwards, radians.
        roll: rotation of the hand about the forearm, radians; at 0 the palm faces downwards.
        depth: position of the grip within the held object: 0 = its near side, 1 = its centre.
        reach: distance between the hand and its object before the action and after the release, metres.
        approach: duration of the approach, frames.
        release: frames from the action's end to the end of the retreat; 0 for a hand that stays.
        twist: rotation vector of the hand relative to what it holds or to its first pose, radians.
        begin, end: positions of a free hand's grip on the table, metres; equal for a hand that rests.
        start, frames: first frame and duration of a free hand's motion.
    """

    action: Action | None
    azimuth: float
    pitch: float
    roll: float
    depth: float
    reach: float
    approach: int
    release: int
    twist: Point
    begin: Point
    end: Point
    start: int
    frames: int


def draw_arm_plan(
    rng: np.random.Generator, action: Action | None, azimuth: float, radius: float, still: bool
) -> ArmPlan:
    """Draw the motion of an arm.

    Args:
        rng: source of randomness.
        action: what the hand carries out, if anything.
        azimuth: mean direction that the arm comes from, radians.
        radius: of the disc of objects, metres.
        still: whether a free hand rests.
    """
    begin, end = (_draw_place(rng, radius) for _ in range(2))
    twist = rng.normal(0, 0.2, 3)
    if still:
        end, twist = begin, np.zeros(3)
    return ArmPlan(
        action=action,
        azimuth=azimuth + float(rng.normal(0, 0.5)),
        pitch=float(rng.uniform(0.15, 1.1)),
        roll=float(rng.choice([rng.normal(0, 0.35), rng.choice([-1, 1]) * rng.normal(1.4, 0.3)], p=(0.6, 0.4))),
        depth=float(rng.uniform(0.0, 0.7)),
        reach=float(rng.uniform(0.06, 0.3)),
        approach=int(rng.integers(15, 50)),
        release=int(rng.integers(15, 40)) if rng.random() < 0.4 else 0,
        twist=_point(twist * (0.5 if action is not None else 1.0)),
        begin=begin,
        end=end,
        start=int(rng.integers(-20, 30)),
        frames=int(rng.integers(15, 60)),
    )


def arm_poses(
    plan: ArmPlan, arm: Arm, held: Float64Array | None, vertices: Float64Array | None, frames: int
) -> Float64Array:
    """Poses of an arm in frames 0 to `frames` - 1.

    Args:
        plan: of the arm.
        arm: its model and grip.
        held: (frames, 4, 4) `world_T_object` of the held object; None for a free hand.
        vertices: (V, 3) of the held object, metres, object frame; None for a free hand.
        frames: number of frames.

    Returns:
        (frames, 4, 4) `world_T_arm`.
    """
    rotation = _rotation(plan)
    forward = rotation[:, 0]
    time = np.arange(frames, dtype=np.float64)
    if plan.action is None or held is None or vertices is None:
        share = minimum_jerk((time - plan.start) / plan.frames)
        begin, end = np.asarray(plan.begin), np.asarray(plan.end)
        grip = begin + share[:, None] * (end - begin)
        poses = _about_grip(rotation, grip, arm, np.asarray(plan.twist) * share[:, None])
        return _above_table(poses, arm)
    start, stop = plan.action.start, plan.action.start + plan.action.frames
    at_start = vertices @ held[start, :3, :3].T + held[start, :3, 3]
    center = (at_start.min(axis=0) + at_start.max(axis=0)) / 2
    near = float(((at_start - center) @ -forward).max())
    touch = center - (1 - plan.depth) * near * forward
    first = _above_table(_about_grip(rotation, touch[None], arm, np.zeros((1, 3))), arm)[0]
    object_T_arm = geometry.inverse(held[start]) @ first
    attached = held @ object_T_arm
    twist = np.asarray(plan.twist) * minimum_jerk((time - start) / plan.action.frames)[:, None]
    grip = attached[:, :3, :3] @ arm.grip + attached[:, :3, 3]
    poses = np.stack(
        [
            _about_grip(one[:3, :3], point[None], arm, angle[None])[0]
            for one, point, angle in zip(attached, grip, twist, strict=True)
        ]
    )
    away = 1 - minimum_jerk((time - start + plan.approach) / plan.approach)
    if plan.release:
        away = away + minimum_jerk((time - stop) / plan.release)
    poses[:, :3, 3] -= plan.reach * away[:, None] * forward
    return poses


def minimum_jerk(share: Float64Array) -> Float64Array:
    """Position along a motion that starts and ends at rest, 0..1, for shares of its time, clipped to 0..1."""
    s = np.clip(share, 0, 1)
    return np.asarray(10 * s**3 - 15 * s**4 + 6 * s**5)


def _rotation(plan: ArmPlan) -> Float64Array:
    """(3, 3) `world_R_arm`."""
    c, s = math.cos(plan.pitch), math.sin(plan.pitch)
    forward = np.array([-c * math.cos(plan.azimuth), -c * math.sin(plan.azimuth), -s])
    up = np.array([0.0, 0.0, 1.0]) + s * forward  # the part of the vertical that is perpendicular to `forward`
    up /= np.linalg.norm(up)
    level = np.stack([forward, np.cross(up, forward), up], axis=1)
    return np.asarray(level @ geometry.so3_exp(np.array([plan.roll, 0.0, 0.0])))


def _about_grip(rotation: Float64Array, grip: Float64Array, arm: Arm, turns: Float64Array) -> Float64Array:
    """Poses (N, 4, 4) with the grip at given points (N, 3), turned about it by rotation vectors (N, 3)."""
    rotations = np.stack([geometry.so3_exp(turn) for turn in turns]) @ rotation
    return geometry.make_transform(rotations, grip - rotations @ arm.grip)


def _above_table(poses: Float64Array, arm: Arm) -> Float64Array:
    """The poses (N, 4, 4), raised together until the hand is above the table in all of them."""
    vertices = arm.model.vertices
    hand = vertices[vertices[:, 0] > -HAND_REACH]
    lowest = (poses[:, 2, :3] @ hand.T).min(axis=1) + poses[:, 2, 3]
    raised = poses.copy()
    raised[:, 2, 3] += max(0.0, 0.002 - float(lowest.min()))
    return raised


def _draw_place(rng: np.random.Generator, radius: float) -> Point:
    x, y = rng.uniform(-1, 1, 2) * max(radius, 0.12)
    return float(x), float(y), float(rng.exponential(0.05))


def _point(values: Float64Array) -> Point:
    x, y, z = map(float, values)
    return x, y, z
