"""What a simulated object is: its surface, its convex collision parts and its rotational symmetry."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from objectflow.geometry.symmetry import SymmetryAxis
from objectflow.typing import Float64Array, LabelImage, UInt8Array


class ModelRef(NamedTuple):
    """Names one model of a library without building it."""

    category: str
    """For example "mug"; of a mesh folder, the folder's or synset's name."""
    name: str
    """For example "mug-00012"; of a mesh folder, the file's path relative to the folder."""


@dataclass(frozen=True, eq=False)
class ObjectModel:
    """A rigid object at its real size.

    The origin of the object frame is the object's centre X. It lies on every symmetry axis, so that a turn of the
    symmetry group keeps X where it is and the paper's translation T needs no correction.
    """

    category: str
    name: str
    vertices: Float64Array
    """(V, 3) metres, object frame. Split at texture seams; closed once equal points are merged. The surface may be
    a union of closed solids that overlap (a mug's handle enters its wall)."""
    faces: LabelImage
    """(F, 3) indices into `vertices`, counter-clockwise seen from outside."""
    uv: Float64Array
    """(V, 2) texture coordinates, mostly in [0, 1]; v runs upwards."""
    parts: tuple[Float64Array, ...]
    """Collision shape: a union of convex hulls. Each (P, 3) metres, object frame, has the points of one hull; some of
    them may lie inside it."""
    symmetry: tuple[SymmetryAxis, ...]
    """All axes of a finite group, each with its highest order. With a continuous axis that can be turned over, that
    axis and one C2 axis across it, which stands for all; a ball has three continuous axes. Empty when only the
    identity maps the object to itself. Geometric: a texture may break it, as in the paper."""
    texture: UInt8Array | None = None
    """(h, w, 3) uint8 RGB, where a mesh file brings its own."""

    @property
    def ref(self) -> ModelRef:
        """The name under which the library finds it again."""
        return ModelRef(self.category, self.name)

    @property
    def radius(self) -> float:
        """Metres from the origin to the furthest vertex."""
        return float(np.linalg.norm(self.vertices, axis=1).max())
