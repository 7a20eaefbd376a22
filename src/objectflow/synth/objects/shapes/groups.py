"""Rotation groups as lists of axes, each with its highest order.

The continuous dihedral group has infinitely many C2 axes perpendicular to the continuous one; one represents all.
"""

from __future__ import annotations

import itertools
import math

from objectflow.geometry.symmetry import SymmetryAxis

Group = tuple[SymmetryAxis, ...]
Vector = tuple[float, float, float]

X: Vector = (1.0, 0.0, 0.0)
Y: Vector = (0.0, 1.0, 0.0)
Z: Vector = (0.0, 0.0, 1.0)
ASYMMETRIC: Group = ()


def cyclic(order: int, axis: Vector = Z) -> Group:
    """C_n about one axis; order 0 is a continuous axis."""
    return (SymmetryAxis(axis, order),)


def dihedral(order: int, phase: float = 0.0) -> Group:
    """D_n: C_n about z, and C2 about n axes perpendicular to it, the first at angle `phase` (radians) from x."""
    if order == 0:
        return (SymmetryAxis(Z, 0), SymmetryAxis(X, 2))
    angles = [phase + math.pi * k / order for k in range(order)]
    return (SymmetryAxis(Z, order), *(SymmetryAxis((math.cos(a), math.sin(a), 0.0), 2) for a in angles))


def cube() -> Group:
    """The rotation group of an axis-aligned cube: three C4, four C3 and six C2 axes."""
    fours = [SymmetryAxis(axis, 4) for axis in (X, Y, Z)]
    s, t = 1 / math.sqrt(3), 1 / math.sqrt(2)
    threes = [SymmetryAxis((s, a * s, b * s), 3) for a, b in itertools.product((1, -1), repeat=2)]
    twos = [SymmetryAxis(axis, 2) for a in (1, -1) for axis in ((t, a * t, 0.0), (t, 0.0, a * t), (0.0, t, a * t))]
    return (*fours, *threes, *twos)
