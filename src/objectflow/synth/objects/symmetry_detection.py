"""Detection of the rotation axes of a mesh: C2 to C12 and continuous, and their finite groups.

Every rotation axis of a surface passes through its centroid and is an eigenvector of its second moment. Where two or
three eigenvalues are equal, the eigenvectors form a plane or a sphere of directions, which is searched. A candidate is
refined by registering the rotated surface with itself, and accepted if the distance between the two is small.
"""

from __future__ import annotations

import numpy as np

from objectflow.geometry.se3 import rotation_angle, so3_exp, so3_log
from objectflow.geometry.symmetry import SymmetryAxis
from objectflow.synth.objects.self_registration import SampledSurface
from objectflow.synth.objects.shapes.solid import surface_center
from objectflow.typing import Float64Array, LabelImage

_EQUAL_MOMENTS = 0.05
"""Maximum difference between equal principal moments, as a share of the largest."""
_LARGEST_GROUP = 60
"""Number of rotations of the icosahedron, the largest finite group of a solid without a continuous axis."""
_SAME_ROTATION = np.deg2rad(10.0)
"""Maximum angle between two rotations that count as equal, radians."""
_SAME_AXIS = np.cos(np.deg2rad(6.0))
"""Minimum absolute cosine of the angle between two axes that count as equal."""


def detect_symmetry(vertices: Float64Array, faces: LabelImage, tolerance: float = 0.01) -> tuple[SymmetryAxis, ...]:
    """Detect the rotation axes of a surface, each with its highest order; all pass through `surface_center`.

    Args:
        vertices: (V, 3) in any unit, about any origin.
        faces: (F, 3); the mesh may be open or inside out.
        tolerance: maximum distance between the rotated surface and the original, as a share of the object's radius.

    Returns:
        All axes of a finite group; for a continuous dihedral group, its axis and one C2 axis perpendicular to it;
        for a ball, three continuous axes. Empty without symmetry.
    """
    center = surface_center(vertices, faces)
    surface = SampledSurface((vertices - center)[faces], np.random.default_rng(0), tolerance)
    moments, directions = np.linalg.eigh(surface.second_moment)
    equal = np.diff(moments) < _EQUAL_MOMENTS * moments[-1]
    found = _Axes()
    for direction in directions.T:
        found.add(direction, surface)
    if found.continuous < 2:
        if equal.all():
            for order in (2, 3):
                _search(_half_sphere(1200), order, surface, found)
        elif equal.any():
            plane = directions[:, :2] if equal[0] else directions[:, 1:]
            angle = np.pi * np.arange(90) / 90
            _search(np.cos(angle)[:, None] * plane[:, 0] + np.sin(angle)[:, None] * plane[:, 1], 2, surface, found)
    return found.group()


class _Axes:
    """The axes found so far, without duplicates."""

    def __init__(self) -> None:
        self._found: list[tuple[Float64Array, int]] = []
        self._implied: list[tuple[Float64Array, int]] = []

    @property
    def continuous(self) -> int:
        return sum(order == 0 for _, order in self._found)

    def add(self, axis: Float64Array, surface: SampledSurface, hint: int | None = None) -> None:
        """Add an axis if it is one of the surface; `hint` is the order at which it is refined."""
        # A principal axis may have a higher order than the axes found so far imply.
        known = self._implied if hint else self._found
        if _listed(axis, known):
            return
        refined = surface.refined(axis, hint or 2)
        for trial in (refined,) if hint else (refined, axis):  # a principal direction may already be exact
            order = surface.order(trial)
            if order is not None and not _listed(trial, known):
                self._found.append((trial, order))
                self._implied = list(self._found) if self.continuous else _completed(self._found)
                return

    def group(self) -> tuple[SymmetryAxis, ...]:
        """The axes of the whole group, in the form that `detect_symmetry` returns."""
        continuous = [axis for axis, order in self._found if order == 0]
        if len(continuous) > 1:
            return tuple(SymmetryAxis(axis, 0) for axis in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)))
        if continuous:
            main = continuous[0]
            across = [axis for axis, order in self._found if order and abs(axis @ main) < 1 - _SAME_AXIS + 0.1]
            flip = across[0] - (across[0] @ main) * main if across else None
            axes = [(main, 0)] + ([(flip / np.linalg.norm(flip), 2)] if flip is not None else [])
            return tuple(_symmetry_axis(*item) for item in axes)
        return tuple(_symmetry_axis(*item) for item in sorted(self._implied, key=lambda item: -item[1]))


def _listed(axis: Float64Array, axes: list[tuple[Float64Array, int]]) -> bool:
    return any(abs(axis @ other) > _SAME_AXIS for other, _ in axes)


def _completed(found: list[tuple[Float64Array, int]]) -> list[tuple[Float64Array, int]]:
    """All axes of the finite group that some axes generate, by multiplying rotations until none is new."""
    generators = [so3_exp(2 * np.pi / order * axis) for axis, order in found]
    group = [np.eye(3)]
    for element in group:  # the list grows during the iteration
        for generator in generators:
            product = generator @ element
            # The trace of product @ g.T is 1 + 2 cos(angle between the two).
            nearest = max(float((product * g).sum()) for g in group)
            if len(group) < _LARGEST_GROUP and nearest < 1 + 2 * np.cos(_SAME_ROTATION):
                group.append(product)
    out = list(found)
    for element in group[1:]:
        axis = so3_log(element) / rotation_angle(element)
        if not any(abs(axis @ seen) > _SAME_AXIS for seen, _ in out):
            out.append((axis, 1 + sum(_is_about(g, axis) for g in group[1:])))
    return out


def _is_about(rotation: Float64Array, axis: Float64Array) -> bool:
    return bool(abs(so3_log(rotation) @ axis) > _SAME_AXIS * rotation_angle(rotation))


def _symmetry_axis(axis: Float64Array, order: int) -> SymmetryAxis:
    largest = axis[np.argmax(np.abs(axis) > 0.9 * np.abs(axis).max())]
    x, y, z = (axis if largest > 0 else -axis) + 0.0
    return SymmetryAxis((float(x), float(y), float(z)), order)


def _half_sphere(count: int) -> Float64Array:
    """(count, 3) directions evenly distributed over a hemisphere (Fibonacci lattice)."""
    i = np.arange(count)
    z = (i + 0.5) / count
    angle = i * np.pi * (3 - np.sqrt(5))
    r = np.sqrt(1 - z**2)
    return np.stack([r * np.cos(angle), r * np.sin(angle), z], axis=1)


def _search(directions: Float64Array, order: int, surface: SampledSurface, found: _Axes) -> None:
    """Try the directions with the smallest distance between the rotated surface and the original."""
    distances = [surface.coarse_distance(direction, order) for direction in directions]
    tried: list[Float64Array] = []
    for i in np.argsort(distances, kind="stable"):
        if len(tried) >= 12 or distances[i] > 0.08 or found.continuous > 1:
            return
        if all(abs(directions[i] @ other) < np.cos(np.deg2rad(9)) for other in tried):
            tried.append(directions[i])
            found.add(directions[i], surface, order)
            if order == 2 and found.continuous == 1 and len(tried) >= 3:
                return  # one perpendicular C2 axis represents all
