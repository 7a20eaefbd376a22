"""Actions on objects: driven velocities, times, and probabilities."""

from __future__ import annotations

import math

import numpy as np
import pytest

from objectflow.synth.physics.recording import FRAME
from objectflow.synth.scenes.actions import (
    ACTION_KINDS,
    ACTION_PROBABILITIES,
    Action,
    draw_action,
    driven_velocity,
    is_driven,
)


def action(kind: str, angle: float = 0.5, path: float = 0.1) -> Action:
    return Action(kind, 0, 10, 30, 0.7, path, 0.8, angle)  # type: ignore[arg-type]


def integrated(one: Action) -> tuple[np.ndarray, np.ndarray]:
    """Translation and rotation vector of a driven object, integrated over the action."""
    translation, rotation, sub = np.zeros(3), np.zeros(3), 50
    for k in range(60 * sub):
        velocity, angular = driven_velocity(one, k / sub, FRAME, np.array([0.0, 0.0, 0.1]))
        translation, rotation = translation + velocity * FRAME / sub, rotation + angular * FRAME / sub
    return translation, rotation


def test_driven_objects_move_by_the_path_and_the_angle_of_the_action() -> None:
    translation, rotation = integrated(action("slide"))
    np.testing.assert_allclose(translation, 0.1 * np.array([math.cos(0.7), math.sin(0.7), 0]), atol=1e-6)
    np.testing.assert_allclose(rotation, [0, 0, 0.5], atol=1e-6)
    translation, rotation = integrated(action("lift"))
    np.testing.assert_allclose(translation, [0, 0, 0.1], atol=1e-6)
    np.testing.assert_allclose(rotation, 0.5 * np.array([-math.sin(0.7), math.cos(0.7), 0]), atol=1e-6)
    translation, rotation = integrated(action("turn"))
    np.testing.assert_allclose(np.r_[translation, rotation], [0, 0, 0, 0, 0, 0.5], atol=1e-6)


def test_toppled_objects_rotate_towards_the_heading_about_an_edge_below_them() -> None:
    one = action("topple")
    velocity, angular = driven_velocity(one, 25.0, FRAME, np.array([0.0, 0.0, 0.1]))
    assert velocity @ one.direction > 0
    np.testing.assert_allclose(np.linalg.norm(velocity), 0.1 * np.linalg.norm(angular))


@pytest.mark.parametrize(
    ("kind", "times"),
    [("push", []), ("slide", [15]), ("turn", [15]), ("topple", [15]), ("lift", [15, 50]), ("fall", [-1, 5])],
)
def test_when_objects_are_driven(kind: str, times: list[int]) -> None:
    assert [time for time in (-1, 5, 15, 50) if is_driven(action(kind), time)] == times


def test_every_kind_of_action_is_drawn() -> None:
    rng = np.random.default_rng(0)
    assert {draw_action(rng, 0, 5).kind for _ in range(200)} == set(ACTION_KINDS)
    assert math.isclose(sum(ACTION_PROBABILITIES), 1)
