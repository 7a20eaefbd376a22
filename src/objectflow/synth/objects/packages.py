"""Long printed boxes such as food packages: cartons of 15 to 32 cm."""

from __future__ import annotations

import numpy as np

from objectflow.synth.objects.model import ObjectModel
from objectflow.synth.objects.shapes.groups import dihedral
from objectflow.synth.objects.shapes.outline import rectangle
from objectflow.synth.objects.shapes.solid import surface_center
from objectflow.synth.objects.shapes.sweep import extrude


def build_package(number: int) -> ObjectModel:
    """Build the package of a number, standing upright (z is its longest side); the same number gives the same one."""
    rng = np.random.default_rng(np.random.SeedSequence([0x504B47, number]))
    length = float(rng.uniform(0.15, 0.32))
    width = length * float(rng.uniform(0.4, 0.75))
    thick = width * float(rng.uniform(0.2, 0.7))
    solid = extrude(rectangle(width, thick), length)
    solid = solid.moved(-surface_center(solid.vertices, solid.faces))
    return ObjectModel(
        category="package",
        name=f"package-{number:06d}",
        vertices=solid.vertices,
        faces=solid.faces,
        uv=solid.uv,
        parts=solid.parts,
        symmetry=dihedral(2),
    )
