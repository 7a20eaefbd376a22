"""Rotation errors up to symmetry, against explicit or sampled rotations; translation errors at the centre."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from helpers.truths import true_object
from objectflow.errors import GeometryError
from objectflow.evaluation.data.truth import PairTruth, TrueObject
from objectflow.evaluation.metrics.object_metrics import ObjectError, score_objects
from objectflow.evaluation.metrics.segmentation_metrics import ObjectMatch
from objectflow.evaluation.metrics.symmetry_error import rotation_error, rotation_group
from objectflow.motion import ObjectMotion
from objectflow.typing import Float64Array

X, Y, Z = np.eye(3)
vectors = st.tuples(*[st.floats(-3, 3)] * 3).map(np.array)


def turn(axis: Float64Array, degrees: float) -> Float64Array:
    return np.asarray(Rotation.from_rotvec(np.deg2rad(degrees) * axis).as_matrix())


def plain_angle(a: Float64Array, b: Float64Array) -> float:
    return math.degrees(math.acos(max(-1.0, min(1.0, (float(np.trace(a.T @ b)) - 1) / 2))))


@pytest.mark.parametrize(
    ("off", "axes", "orders", "error"),
    [
        (turn(Z, 50), [], [], 50),
        (turn(Z, 50), [Z], [4], 40),  # the nearest rotation of the group, by 90 degrees, is 40 degrees away
        (turn(Z, 90), [Z], [4], 0),
        (turn(Z, 100), [Z], [3], 20),  # 120 - 100
        (turn(Z, 170), [Z], [2], 10),
        (turn(X, 50), [Z], [4], 50),
        (turn(Z, 50), [Z], [0], 0),
        (turn(X, 30) @ turn(Z, 77), [Z], [0], 30),  # only the tilt of the axis is observable
        (turn(X, 170), [Z], [0], 170),
        (turn(X, 170), [Z, X], [0, 2], 10),  # a cylinder flipped about another axis than the listed one
        (turn(Y, 170) @ turn(Z, 33), [Z, X], [0, 2], 10),
        (turn(X, 50), [X, Y, Z], [0, 0, 0], 0),  # a ball
        (turn(Z, 50), [Z, Z], [0, 4], 0),
        (turn(X, 50), [Z, X], [0, 4], 0),  # a quarter turn maps the continuous axis onto another one: a ball
        (turn(X, 180) @ turn(Z, 8), [X, Y, Z], [2, 2, 2], 8),  # a box
    ],
)
def test_errors_up_to_symmetry(off: Float64Array, axes: list[Float64Array], orders: list[int], error: float) -> None:
    true = turn(np.array([0.36, 0.48, 0.8]), 71)
    # The axes are given in the current frame, so a rotation of the group comes before the true rotation.
    assert rotation_error(true @ off, true, axes, orders) == pytest.approx(error, abs=1e-5)


@pytest.mark.parametrize(
    ("axes", "orders", "size"),
    [
        ([], [], 1),
        ([Z], [5], 5),
        ([Z, X], [2, 2], 4),  # the third axis follows
        ([Z, X], [6, 2], 12),  # a hexagonal prism
        ([X, turn(Z, 60) @ X], [2, 2], 6),  # two half turns about axes 60 degrees apart make a rotation by 120
        ([X, Y], [4, 4], 24),  # a cube
        ([X + Y + Z, X - Y - Z], [3, 3], 12),  # a tetrahedron
        ([np.array([0, 1, (1 + 5**0.5) / 2]), X + Y + Z], [5, 3], 60),  # an icosahedron
        ([Z, X], [36, 2], 72),
    ],
)
def test_the_size_of_groups(axes: list[Float64Array], orders: list[int], size: int) -> None:
    group = rotation_group(axes, orders)
    assert group.shape == (size, 3, 3)
    assert np.allclose(group[0], np.eye(3))
    assert np.allclose(group @ np.swapaxes(group, -1, -2), np.eye(3))


def test_inexact_axes_still_generate_their_group() -> None:
    tilted = [turn(Y, 0.5) @ Z, turn(Z, 0.4) @ X, Y]
    assert len(rotation_group(tilted, [2, 2, 2])) == 4


@pytest.mark.parametrize(
    ("axes", "orders"), [([Z], []), ([Z], [1]), ([Z], [-2]), ([0 * Z], [2]), ([X, turn(Z, 7.3) @ X + 0.1 * Z], [5, 7])]
)
def test_axes_that_make_no_group(axes: list[Float64Array], orders: list[int]) -> None:
    with pytest.raises(GeometryError):
        rotation_error(np.eye(3), np.eye(3), axes, orders)


@given(vectors, vectors, vectors, st.integers(2, 12), st.integers(0, 11))
def test_one_axis_against_every_turn(p: Float64Array, t: Float64Array, a: Float64Array, order: int, k: int) -> None:
    axis = np.array([0.6, 0.0, 0.8]) if np.linalg.norm(a) < 0.1 else a / np.linalg.norm(a)
    P, T = Rotation.from_rotvec(p).as_matrix(), Rotation.from_rotvec(t).as_matrix()
    error = rotation_error(P, T, [axis], [order])
    expected = min(plain_angle(P, T @ turn(axis, 360 * i / order)) for i in range(order))
    assert error == pytest.approx(expected, abs=1e-4)
    # Rotating either one by an element of the group changes nothing.
    g = turn(axis, 360 * k / order)
    assert rotation_error(P @ g, T, [axis], [order]) == pytest.approx(error, abs=1e-4)
    assert rotation_error(P, T @ g, [axis], [order]) == pytest.approx(error, abs=1e-4)


@given(vectors, vectors, st.booleans())
def test_a_continuous_axis_against_fine_turns(p: Float64Array, t: Float64Array, flips: bool) -> None:
    P, T = Rotation.from_rotvec(p).as_matrix(), Rotation.from_rotvec(t).as_matrix()
    axes, orders = ([Z, X], [0, 2]) if flips else ([Z], [0])
    E = T.T @ P
    angles = np.deg2rad(np.arange(0, 360, 0.25))[:, None]
    turns = Rotation.from_rotvec(angles * Z).as_matrix()
    if flips:
        turns = np.concatenate([turns, turns @ turn(X, 180)])
    cosines = (np.einsum("kij,ij->k", turns, E) - 1) / 2
    assert rotation_error(P, T, axes, orders) == pytest.approx(
        math.degrees(math.acos(min(1.0, cosines.max()))), abs=0.15
    )


def motion(id_: int, T: Float64Array) -> ObjectMotion:
    return ObjectMotion(id=id_, pixels=1, score=1.0, moving=True, center=np.zeros(3), prev_T_curr=T)


def truth(*objects: TrueObject) -> PairTruth:
    labels = np.array([[obj.label for obj in objects]], np.int32)
    return PairTruth(
        "key", "key", labels, np.zeros((1, len(objects), 3), np.float32), objects, labels > 0, frozenset({1})
    )


def test_objects_errors() -> None:
    center = np.array([0.1, 0.0, 1.0])
    # A rotation by 90 degrees about z through the centre, and 3 cm along x: t = X + (0.03, 0, 0) - R X.
    T = np.eye(4)
    T[:3, :3] = turn(Z, 90)
    T[:3, 3] = center + 0.03 * X - T[:3, :3] @ center
    guess = np.eye(4)
    guess[:3, 3] = [0.03, 0.04, 0]
    free = true_object(1, center, T)
    square = true_object(2, center, T, axes=Z, orders=(4,))
    ball = true_object(3, center, T, rotation_known=False)
    new = true_object(4, center, T, in_both=False)
    matches = [ObjectMatch(label, label + 10, 0.9) for label in (1, 2, 3, 4)] + [ObjectMatch(1, 99, 0.1)]
    guesses = [motion(label + 10, guess) for label in (1, 2, 3, 4)]
    errors = score_objects(guesses, truth(free, square, ball, new), matches)
    # An object visible in one frame only has no error, and neither has a match without a predicted motion.
    assert [error.label for error in errors] == [1, 2, 3]
    # The true motion takes the centre to (0.13, 0, 1), the predicted one to (0.13, 0.04, 1).
    assert [error.translation_cm for error in errors] == pytest.approx([4, 4, 4])
    assert [error.rotation_deg for error in errors] == pytest.approx([90, 0, math.nan], nan_ok=True, abs=1e-5)
    assert [error.moving for error in errors] == [True, False, False]


@pytest.mark.parametrize(
    ("rotation", "translation", "good"),
    [(4.9, 1.9, True), (5.0, 1.9, False), (4.9, 2.0, False), (math.nan, 1.9, True), (math.nan, 2.0, False)],
)
def test_good_is_under_five_degrees_and_two_centimetres(rotation: float, translation: float, good: bool) -> None:
    assert ObjectError(1, 1.0, rotation, translation, True).good is good
