"""A simulated object: its surface, its convex collision parts and its rotational symmetry."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from objectflow.geometry.symmetry import SymmetryAxis
from objectflow.typing import Float64Array, LabelImage, UInt8Array


class ModelRef(NamedTuple):
    """Reference to one model of a library."""

    category: str
    """For example "mug"; in a mesh folder, the name of the folder or synset."""
    name: str
    """For example "mug-00012"; in a mesh folder, the file's path relative to the folder."""


@dataclass(frozen=True, eq=False)
class ObjectModel:
    """A rigid object at its real size.

    The origin of the object frame is the object's centre X. It is on every symmetry axis, so that rotations of the
    symmetry group leave X in place and the paper's translation T needs no correction.
    """

    category: str
    name: str
    vertices: Float64Array
    """(V, 3) metres, object frame. Split at texture seams; closed once equal points are merged. The surface may be
    a union of overlapping closed solids (a mug's handle extends into its wall)."""
    faces: LabelImage
    """(F, 3) indices into `vertices`, counter-clockwise seen from outside."""
    uv: Float64Array
    """(V, 2) texture coordinates, mostly in [0, 1]; v runs upwards."""
    parts: tuple[Float64Array, ...]
    """Collision shape: a union of convex hulls. Each (P, 3) metres, object frame, holds the points of one hull; some
    of them may be inside it."""
    symmetry: tuple[SymmetryAxis, ...]
    """All axes of a finite group, each with its highest order. A continuous dihedral group has its axis and one C2
    axis perpendicular to it, which represents all; a ball has three continuous axes. Empty if only the identity maps
    the object to itself. Geometric: textures are ignored, as in the paper."""
    texture: UInt8Array | None = None
    """(h, w, 3) uint8 RGB texture of a mesh file, if it has one."""

    @property
    def radius(self) -> float:
        """Distance from the origin to the furthest vertex, metres."""
        return float(np.linalg.norm(self.vertices, axis=1).max())
