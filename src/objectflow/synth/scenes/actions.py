"""Actions on objects as plain data: push, slide, turn, lift, topple, fall."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from objectflow.typing import Float64Array

ActionKind = Literal["push", "slide", "turn", "lift", "topple", "fall", "carry"]

ACTION_KINDS: tuple[ActionKind, ...] = ("push", "slide", "turn", "lift", "topple", "fall")
"""Kinds that `draw_action` draws."""
ACTION_PROBABILITIES = (0.17, 0.2, 0.13, 0.17, 0.13, 0.2)
"""Probability of each kind, in the order of `ACTION_KINDS`."""


@dataclass(frozen=True)
class Action:
    """An action on one object.

    Attributes:
        kind: "push" (an impulse along the ground, then free motion), "slide" (driven along the ground), "turn" (driven
            about the vertical), "lift" (driven upwards, tilted on the way, and held), "topple" (driven over an edge,
            then released), "fall" (held in the air, then released), "carry" (driven upwards and along the ground,
            turned on the way, and held).
        object: index of the object in the scene, from 0.
        start, frames: first frame and duration of the driven motion.
        heading: direction along the ground, radians.
        path: distance along the ground (slide, carry) or upwards (lift), metres.
        speed: initial speed (push), metres per second.
        angle: rotation about the vertical (slide, turn, carry) or tilt (lift, topple), radians.
        rise: distance upwards (carry), metres.
    """

    kind: ActionKind
    object: int
    start: int
    frames: int
    heading: float
    path: float
    speed: float
    angle: float
    rise: float = 0.0

    @property
    def direction(self) -> Float64Array:
        """(3,) unit vector along the ground."""
        return np.array([math.cos(self.heading), math.sin(self.heading), 0.0])

    @property
    def axis(self) -> Float64Array:
        """(3,) unit vector: the horizontal axis of the tilt, perpendicular to the heading."""
        return np.array([-math.sin(self.heading), math.cos(self.heading), 0.0])


def draw_action(rng: np.random.Generator, item: int, latest: int) -> Action:
    """Draw an action on object `item` that starts no later than frame `latest`."""
    kind = ACTION_KINDS[int(rng.choice(len(ACTION_KINDS), p=ACTION_PROBABILITIES))]
    angle = {
        "slide": rng.uniform(-0.6, 0.6),
        "turn": rng.choice((-1, 1)) * rng.uniform(0.3, 2.2),
        "lift": rng.uniform(-0.6, 0.6),
        "topple": rng.uniform(0.5, 1.1),
    }
    path = {"slide": rng.uniform(0.03, 0.2), "lift": rng.uniform(0.03, 0.25)}
    return Action(
        kind=kind,
        object=item,
        start=int(rng.integers(0, latest + 1)),
        frames=int(rng.integers(8, 20) if kind == "topple" else rng.integers(12, 70)),
        heading=float(rng.uniform(0, 2 * math.pi)),
        path=float(path.get(kind, 0.0)),
        speed=float(rng.uniform(0.4, 1.3)),
        angle=float(angle.get(kind, 0.0)),
    )


def is_driven(action: Action, time: float) -> bool:
    """Whether the action prescribes its object's velocity at a time in frames; gravity is then switched off."""
    if action.kind == "fall":
        return time < action.start
    if action.kind == "push":
        return False
    return action.start <= time and (action.kind in ("lift", "carry") or time < action.start + action.frames)


def driven_velocity(action: Action, time: float, frame: float, arm: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Velocity of a driven object's origin, m/s, and its angular velocity, rad/s, in the world frame.

    Motions start and end at rest (the fifth-order minimum-jerk polynomial); toppling ends at full speed.

    Args:
        action: the action that drives the object.
        time: time in frames, may be fractional.
        frame: duration of a frame, seconds.
        arm: (3,) vector from the tipping edge to the object's origin, metres.
    """
    zero = np.zeros(3)
    share = (time - action.start) / action.frames
    if action.kind == "fall" or not 0 <= share < 1:
        return zero, zero
    rate = 30 * share**2 * (1 - share) ** 2 / (action.frames * frame)
    upwards = np.array([0.0, 0.0, 1.0])
    if action.kind == "slide":
        return rate * action.path * action.direction, rate * action.angle * upwards
    if action.kind == "turn":
        return zero, rate * action.angle * upwards
    if action.kind == "carry":
        return rate * (action.path * action.direction + action.rise * upwards), rate * action.angle * upwards
    if action.kind == "lift":
        return rate * action.path * upwards, rate * action.angle * action.axis
    angular = 2 * share / (action.frames * frame) * action.angle * action.axis
    return np.cross(angular, arm), angular
