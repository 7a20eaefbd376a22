"""Large smooth bodies that stand outside the view, between a lamp and the table, and cast shadows into the image."""

from __future__ import annotations

import numpy as np

from objectflow.synth.objects.model import ObjectModel
from objectflow.synth.objects.shapes.outline import superellipse
from objectflow.synth.objects.shapes.solid import surface_center
from objectflow.synth.objects.shapes.sweep import tube


def build_shadow_caster(number: int) -> ObjectModel:
    """Build the body of a number, 0.25 to 0.6 m long: about a head, a forearm or a lamp's arm, up to a torso."""
    rng = np.random.default_rng(np.random.SeedSequence([0x534844, number]))
    length, radius = float(rng.uniform(0.25, 0.6)), float(rng.uniform(0.03, 0.13))
    share = np.array([0.0, 0.06, 0.2, 0.5, 0.8, 0.94, 1.0])
    path = np.column_stack([length * share, 0.08 * length * np.sin(3 * share), np.zeros(7)])
    width = radius * np.array([0.3, 0.7, 1.0, rng.uniform(0.6, 1.1), 1.0, 0.7, 0.3])
    solid = tube(path, width, superellipse(14, 2.2, float(rng.uniform(0.5, 1.0))), parts=1)
    solid = solid.moved(-surface_center(solid.vertices, solid.faces))
    return ObjectModel(
        category="shadow-caster",
        name=f"shadow-caster-{number:06d}",
        vertices=solid.vertices,
        faces=solid.faces,
        uv=solid.uv,
        parts=solid.parts,
        symmetry=(),
    )
