"""What is done to objects: pushed, slid, turned, lifted, toppled or let fall; drawn as plain data."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from objectflow.typing import Float64Array

Kind = Literal["push", "slide", "turn", "lift", "topple", "fall"]

KINDS: tuple[Kind, ...] = ("push", "slide", "turn", "lift", "topple", "fall")
SHARES = (0.17, 0.2, 0.13, 0.17, 0.13, 0.2)
"""How often each is drawn."""


@dataclass(frozen=True)
class Action:
    """What happens to one object.

    Attributes:
        kind: "push" (a blow along the ground, then it is on its own), "slide" (led along the ground), "turn" (about
            the vertical), "lift" (led up, tilted on the way, and held), "topple" (tipped over an edge, then let go),
            "fall" (held in the air, then let go).
        object: its place in the scene, from 0.
        start, frames: when it begins, and for how long the object is led.
        heading: radians; where to, on the ground.
        path: metres along the ground (slide), or upwards (lift).
        speed: metres a second (push).
        angle: radians: about the vertical (slide, turn), of the tilt (lift, topple).
    """

    kind: Kind
    object: int
    start: int
    frames: int
    heading: float
    path: float
    speed: float
    angle: float

    @property
    def direction(self) -> Float64Array:
        """(3,) unit vector along the ground."""
        return np.array([math.cos(self.heading), math.sin(self.heading), 0.0])

    @property
    def axis(self) -> Float64Array:
        """(3,) unit vector: the axis of the tilt, level and across the heading."""
        return np.array([-math.sin(self.heading), math.cos(self.heading), 0.0])


def draw_action(rng: np.random.Generator, item: int, latest: int) -> Action:
    """An action on an object, which begins at frame `latest` at the latest."""
    kind = KINDS[int(rng.choice(len(KINDS), p=SHARES))]
    turn = {
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
        angle=float(turn.get(kind, 0.0)),
    )


def is_led(action: Action, time: float) -> bool:
    """Whether an object's velocity is the action's at a time, in frames: gravity must not pull at it then."""
    if action.kind == "fall":
        return time < action.start
    if action.kind == "push":
        return False
    return action.start <= time and (action.kind == "lift" or time < action.start + action.frames)


def led_velocity(action: Action, time: float, frame: float, arm: Float64Array) -> tuple[Float64Array, Float64Array]:
    """The velocity of a led object's origin, m/s, and its angular velocity, rad/s, in the world.

    Paths begin and end at rest (the fifth-order polynomial of least jerk); toppling ends at full speed.

    Args:
        action: what leads it.
        time: in frames, fractions too.
        frame: seconds a frame.
        arm: (3,) metres from the edge over which it is tipped to its origin.
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
    if action.kind == "lift":
        return rate * action.path * upwards, rate * action.angle * action.axis
    spin = 2 * share / (action.frames * frame) * action.angle * action.axis
    return np.cross(spin, arm), spin
