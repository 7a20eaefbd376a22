"""Properties of the reduction of rotations, and detection on solids of another library."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from objectflow.errors import GeometryError
from objectflow.geometry.symmetry import SymmetryAxis, reduce_motion, reduce_rotation, twist_angle, wrap
from objectflow.synth.objects.model import ModelRef
from objectflow.synth.objects.procedural import ProceduralLibrary
from objectflow.synth.objects.shapes.groups import cube, cyclic, dihedral
from objectflow.synth.objects.symmetry_detection import detect_symmetry
from objectflow.typing import Float64Array

FINITE = {
    **{f"C{n}": cyclic(n) for n in (2, 3, 4, 5, 6, 7, 12)},
    **{f"D{n}": dihedral(n) for n in (2, 3, 4, 6)},
    "cube": cube(),
}
rotations = st.integers(0, 2**32 - 1).map(lambda seed: Rotation.random(random_state=seed).as_matrix())


def elements(group: tuple[SymmetryAxis, ...]) -> list[Float64Array]:
    """All distinct rotations about the axes of a group."""
    turns = [np.eye(3)]
    for axis in group:
        for k in range(1, axis.order):
            turn = Rotation.from_rotvec(2 * np.pi * k / axis.order * np.array(axis.axis)).as_matrix()
            if min(np.abs(turn - seen).max() for seen in turns) > 1e-6:
                turns.append(turn)
    return turns


def angle(rotation: Float64Array) -> float:
    return float(Rotation.from_matrix(rotation).magnitude())


@pytest.mark.parametrize(("name", "size"), [("C5", 5), ("D2", 4), ("D3", 6), ("D4", 8), ("D6", 12), ("cube", 24)])
def test_the_lists_of_axes_contain_the_whole_group(name: str, size: int) -> None:
    turns = elements(FINITE[name])
    assert len(turns) == size
    products = [a @ b for a in turns for b in turns]
    assert all(min(np.abs(p - turn).max() for turn in turns) < 1e-9 for p in products)


@pytest.mark.parametrize("name", FINITE)
@settings(max_examples=40, deadline=None)
@given(prev=rotations, curr=rotations)
def test_a_finite_group_gives_the_smallest_rotation(name: str, prev: Float64Array, curr: Float64Array) -> None:
    raw = prev @ curr.T
    reduced = reduce_motion(prev, curr, FINITE[name])
    choices = [prev @ g @ curr.T for g in elements(FINITE[name])]
    assert min(np.abs(choice - reduced).max() for choice in choices) < 1e-9  # the raw rotation times an element
    assert angle(reduced) == pytest.approx(min(angle(choice) for choice in choices), abs=1e-7)
    for axis in FINITE[name]:
        assert abs(twist_angle(reduced, curr @ axis.axis)) <= np.pi / axis.order + 1e-7
    if angle(raw) < np.pi / 12 - 1e-9:  # no element of these groups can reduce it
        np.testing.assert_allclose(reduced, raw, atol=1e-12)


@settings(max_examples=60, deadline=None)
@given(prev=rotations, curr=rotations)
def test_a_continuous_axis_keeps_its_direction_and_loses_its_twist(prev: Float64Array, curr: Float64Array) -> None:
    axis = np.array([0.0, 0.6, 0.8])
    reduced = reduce_motion(prev, curr, [SymmetryAxis((0.0, 0.6, 0.8), 0)])
    np.testing.assert_allclose(reduced @ curr @ axis, prev @ axis, atol=1e-9)
    assert angle(reduced) == pytest.approx(np.arccos(np.clip((curr @ axis) @ (prev @ axis), -1, 1)), abs=1e-6)


@settings(max_examples=60, deadline=None)
@given(prev=rotations, curr=rotations)
def test_a_cylinder_rotates_by_at_most_a_right_angle(prev: Float64Array, curr: Float64Array) -> None:
    reduced = reduce_motion(prev, curr, dihedral(0))
    cosine = abs(curr[:, 2] @ prev[:, 2])
    assert abs((reduced @ curr[:, 2]) @ prev[:, 2]) == pytest.approx(1, abs=1e-9)
    assert angle(reduced) == pytest.approx(np.arccos(np.minimum(cosine, 1)), abs=1e-6)


def test_a_ball_does_not_rotate_and_an_asymmetric_object_keeps_its_rotation() -> None:
    prev, curr = Rotation.random(2, random_state=3).as_matrix()
    ball = [SymmetryAxis((1.0, 0.0, 0.0), 0), SymmetryAxis((0.0, 1.0, 0.0), 0)]
    np.testing.assert_array_equal(reduce_motion(prev, curr, ball), np.eye(3))
    np.testing.assert_allclose(reduce_motion(prev, curr, ()), prev @ curr.T)


def test_the_rotation_about_the_axis_follows_the_papers_rule() -> None:
    """C4 about z: 100 degrees become 10, -50 become 40, 45 remain, -45 become 45."""
    for given_angle, expected in ((100, 10), (-50, 40), (45, 45), (-45, 45), (44, 44), (135, 45)):
        raw = Rotation.from_euler("z", given_angle, degrees=True).as_matrix()
        reduced = reduce_rotation(raw, [[0, 0, 1]], [[0, 0, 1]], [4])
        np.testing.assert_allclose(
            Rotation.from_matrix(reduced).as_euler("xyz", degrees=True), [0, 0, expected], atol=1e-9
        )


def test_the_swing_is_kept_when_the_twist_is_removed() -> None:
    """The twist is that of the swing-twist decomposition, not an Euler angle."""
    swing = Rotation.from_rotvec([0.5, 0, 0])
    raw = (swing * Rotation.from_rotvec([0, 0, 2.0])).as_matrix()
    np.testing.assert_allclose(reduce_rotation(raw, [raw[:, 2]], [[0, 0, 1]], [0]), swing.as_matrix(), atol=1e-12)


def test_wrap_keeps_the_upper_end() -> None:
    for n in (2, 3, 4, 12):
        assert wrap(np.pi / n, n) == pytest.approx(np.pi / n)
        assert wrap(-np.pi / n, n) == pytest.approx(np.pi / n)
        assert wrap(0.9 * np.pi / n + 2 * np.pi, n) == pytest.approx(0.9 * np.pi / n)
    assert wrap(2.5, 0) == 0


@pytest.mark.parametrize(
    ("category", "number"), [("box", 0), ("dumbbell", 0), ("book", 0), ("screwdriver", 1), ("cup", 1)]
)
def test_the_reduced_motion_looks_the_same_and_moves_the_center_alike(category: str, number: int) -> None:
    """The reduced motion maps the object to the same set of points, about the same centre X + T."""
    model = ProceduralLibrary().load(ModelRef(category, f"{category}-{number:05d}"))
    rng = np.random.default_rng(number)
    prev, curr = Rotation.random(2, random_state=number).as_matrix()
    T, X = rng.normal(size=3), rng.normal(size=3)
    seen = model.vertices @ curr.T + X
    truth = model.vertices @ prev.T + X + T
    explained = (seen - X) @ reduce_motion(prev, curr, model.symmetry).T + X + T
    # The outer vertices only: the faces of a cube are fans with tips on two sides.
    corners = np.linalg.norm(model.vertices, axis=1) > 0.8 * model.radius
    assert np.max(cKDTree(truth).query(explained[corners])[0]) < 1e-9


def test_bad_input_is_refused() -> None:
    R = Rotation.from_euler("x", 0.5).as_matrix()
    with pytest.raises(GeometryError, match="at least 2"):
        reduce_rotation(R, [R[:, 2]], [[0, 0, 1]], [1])
    with pytest.raises(GeometryError, match="does not map"):
        reduce_rotation(R, [[0, 0, 1]], [[0, 0, 1]], [2])
    with pytest.raises(GeometryError, match="needs a"):
        reduce_rotation(R, [[0, 0, 1]], [[0, 0, 1]], [2, 2])


def solids() -> dict[str, tuple[trimesh.Trimesh, dict[int, int]]]:
    make = trimesh.creation
    leaning, sheared = make.box((0.1, 0.02, 0.03)), make.box((0.1, 0.02, 0.03))
    leaning.vertices[leaning.vertices[:, 0] > 0] += [0, 0, 0.05]
    sheared.vertices[sheared.vertices[:, 0] > 0] += [0, 0.02, 0.05]
    return {
        "ball": (make.icosphere(subdivisions=4, radius=0.05), {0: 3}),
        "cylinder": (make.cylinder(0.03, 0.1, sections=64), {0: 1, 2: 1}),
        "cylinder with equal moments of inertia": (make.cylinder(0.05, 0.0866, sections=64), {0: 1, 2: 1}),
        "cone": (make.cone(0.03, 0.1, sections=64), {0: 1}),
        "box": (make.box((0.05, 0.07, 0.1)), {2: 3}),
        "square prism": (make.box((0.05, 0.05, 0.1)), {4: 1, 2: 4}),
        "cube": (make.box((0.1, 0.1, 0.1)), {4: 3, 3: 4, 2: 6}),
        "seven sides": (make.cone(0.05, 0.06, sections=7), {7: 1}),
        "icosahedron": (make.icosahedron(), {5: 6, 3: 10, 2: 15}),
        "torus": (make.torus(0.05, 0.012, major_sections=64), {0: 1, 2: 1}),
        "leaning box": (leaning, {2: 1}),
        "box sheared twice": (sheared, {}),
    }


@pytest.mark.parametrize("name", solids())
def test_detection_on_solids_of_another_library(name: str) -> None:
    mesh, expected = solids()[name]
    turn = Rotation.random(random_state=5).as_matrix()
    found = detect_symmetry(np.asarray(mesh.vertices) @ turn.T + [0.3, -1, 2], np.asarray(mesh.faces, dtype=np.int32))
    assert Counter(axis.order for axis in found) == Counter(expected)
    if name in {"cone", "cylinder", "torus"}:
        assert abs(np.dot(found[0].axis, turn[:, 2])) > np.cos(np.deg2rad(0.5))


def test_detection_needs_no_closed_or_oriented_mesh() -> None:
    mesh = trimesh.creation.cylinder(0.03, 0.1, sections=48)
    open_faces = np.asarray(mesh.faces[np.abs(mesh.face_normals[:, 2]) < 0.5], dtype=np.int32)
    open_faces[::3] = open_faces[::3, ::-1]
    found = detect_symmetry(np.asarray(mesh.vertices), open_faces)
    assert Counter(axis.order for axis in found) == Counter({0: 1, 2: 1})
