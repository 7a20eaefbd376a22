"""Actions one after another on the objects of one scene, with rests between them."""

from __future__ import annotations

import dataclasses

import numpy as np

from objectflow.synth.scenes.actions import Action, draw_action

STEP = 10
"""Number of simulated frames, at 60 Hz, between two frames of a sequence."""
FIRST_START = 2
"""Frame of the sequence at which the first action starts."""
DURATION = (24, 60)
"""Simulated frames: minimum and maximum duration of an action."""
REST = (20, 60)
"""Simulated frames: minimum and maximum rest after an action."""
PUSH_SPEED = (0.25, 0.7)
"""Metres per second: range of the initial speed of a push."""
HELD = ("lift",)
"""Kinds of action whose object is held afterwards; it has no further action."""
LEFT_OUT = ("fall",)
"""Kinds of action that are not drawn: a falling object would hang in the air until its turn."""


def draw_sequence_actions(rng: np.random.Generator, count: int, frames: int) -> tuple[Action, ...]:
    """Draw pushes, slides, turns, lifts and topplings that follow each other.

    Args:
        rng: source of randomness.
        count: number of objects in the scene.
        frames: number of frames of the sequence, `STEP` simulated frames apart.

    Returns:
        Actions in order of their start; each ends, and is followed by a rest, before the next one starts.
    """
    free = list(range(count))
    actions: list[Action] = []
    start, last = FIRST_START * STEP, (frames - 1) * STEP
    while free:
        duration = int(rng.integers(DURATION[0], DURATION[1] + 1))
        if start + duration > last:
            break
        item = int(free[int(rng.integers(len(free)))])
        action = draw_action(rng, item, 0)
        while action.kind in LEFT_OUT:
            action = draw_action(rng, item, 0)
        speed = float(rng.uniform(*PUSH_SPEED))
        action = dataclasses.replace(action, start=start, frames=duration, speed=speed)
        actions.append(action)
        if action.kind in HELD:
            free.remove(item)
        start += duration + int(rng.integers(REST[0], REST[1] + 1))
    return tuple(actions)
