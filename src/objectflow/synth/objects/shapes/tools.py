"""Tools and toys: knife, spoon, hammer, screwdriver, dumbbell, block, pyramid, ring."""

from __future__ import annotations

import numpy as np
from numpy.random import Generator

from objectflow.geometry.symmetry import SymmetryAxis
from objectflow.synth.objects.shapes.groups import ASYMMETRIC, Group, cube, cyclic, dihedral
from objectflow.synth.objects.shapes.outline import circle, fluted, polygon, rectangle, rounded, superellipse
from objectflow.synth.objects.shapes.revolve import revolve, vessel
from objectflow.synth.objects.shapes.solid import Solid, join, loft
from objectflow.synth.objects.shapes.sweep import extrude, hoop, segment_hulls, tube

Shape = tuple[Solid, Group]

TO_X = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
"""Rotates the z axis to the x axis."""


def knife(rng: Generator) -> Shape:
    """A handle and a blade along z; single-edged, or double-edged and then symmetric under half a turn."""
    length, width, t = rng.uniform(0.1, 0.17), rng.uniform(0.02, 0.034), rng.uniform(0.0018, 0.003)
    grip_length, grip = rng.uniform(0.09, 0.12), rng.uniform(0.009, 0.012)
    s = np.linspace(0, 1, 12)
    double = rng.random() < 0.25
    if double:
        half = width / 2 * np.sqrt(1 - (0.97 * s) ** 4)
        back, edge = half, -half
    else:
        back = np.full(12, width * 0.45)
        edge = back - width * np.sqrt(1 - (0.98 * s) ** rng.uniform(2.5, 6))
    z = length * s - 0.004
    middle = (back + edge) / 2 if double else back * 0.7 + edge * 0.3
    y = np.stack([back, middle, edge, middle], axis=1)
    thick = t / 2 * (1 - 0.5 * s)
    x = np.stack([0 * s, thick, 0 * s, -thick], axis=1)
    if not double:  # the back of a blade is as thick as its middle
        y = np.stack([back, middle, edge, middle, back], axis=1)
        x = np.stack([thick, thick, 0 * s, -thick, -thick], axis=1)
    rings = np.stack([x, y, np.broadcast_to(z[:, None], x.shape)], axis=-1)
    blade = loft(rings, segment_hulls(rings, 3))
    profile = rounded(
        [(0, -grip_length), (grip, -grip_length), (grip * 0.8, -grip_length * 0.5), (grip, 0), (0, 0)], 0.006
    )
    handle = revolve(profile, superellipse(24, 3.0, 1.0)[:, ::-1] * [0.62, 1.0])
    return join([blade, handle]), cyclic(2) if double else ASYMMETRIC


def spoon(rng: Generator) -> Shape:
    """An oval bowl and a bent handle."""
    a, depth, t = rng.uniform(0.024, 0.034), rng.uniform(0.009, 0.014), 0.002
    angle = np.linspace(0.35, np.pi / 2, 6)
    curve = np.concatenate([[[0, 0]], np.stack([a * np.sin(angle), depth * (1 - np.cos(angle))], axis=1)])
    curve[1:, 1] -= curve[1, 1]
    rim = curve[-1, 1]
    dish = vessel(curve, t, superellipse(40, 2.0, rng.uniform(0.6, 0.8)), wedges=10, floor=t)
    length, rise = rng.uniform(0.1, 0.15), rng.uniform(0.005, 0.025)
    s = np.linspace(0, 1, 12)
    path = np.stack([a - 0.002 + length * s, 0 * s, rim - 0.001 + rise * np.sin(s * np.pi * 0.9)], axis=1)
    width = 0.004 + 0.004 * s**2
    return join([dish, tube(path, width, superellipse(12, 2.5, 0.38), parts=4)]), ASYMMETRIC


def hammer(rng: Generator) -> Shape:
    """A handle along z with a head across it: a peen hammer, or a mallet, symmetric under half a turn."""
    length, grip = rng.uniform(0.18, 0.27), rng.uniform(0.009, 0.013)
    handle_curve = rounded(
        [(0, 0), (grip, 0), (grip, length * 0.35), (grip * 0.75, length * 0.6), (grip * 0.75, length), (0, length)],
        0.006,
    )
    handle = revolve(handle_curve, superellipse(24, 2.4, 0.8))
    at = (0, 0, length - 0.018)
    if rng.random() < 0.3:
        R, half = rng.uniform(0.02, 0.032), rng.uniform(0.035, 0.05)
        curve = rounded([(0, -half), (R, -half), (R, half), (0, half)], 0.004)
        return join([handle, revolve(curve).moved(at, TO_X)]), cyclic(2)
    R, face, tail = rng.uniform(0.012, 0.016), rng.uniform(0.03, 0.04), rng.uniform(0.05, 0.06)
    s = np.linspace(0, 1, 8)
    taper = np.stack([R * (1 - 0.8 * s), R * (1 - 0.25 * s)], axis=1)  # the tail flattens to an edge
    outline = superellipse(16, 3.0)
    rings = np.concatenate(
        [outline[None] * taper[:, None, ::-1], np.broadcast_to((-tail * s)[:, None, None], (8, 16, 1))], axis=-1
    )
    rings[:, :, 0] -= R * 0.9 * (s**2)[:, None]  # and bends towards the handle
    peen = loft(rings, segment_hulls(rings, 3)).moved(at, TO_X)
    head = revolve(
        rounded(
            [(0, -0.004), (R * 1.05, -0.004), (R * 0.85, face * 0.5), (R, face * 0.6), (R, face), (0, face)], 0.003
        )
    )
    return join([handle, peen, head.moved(at, TO_X)]), ASYMMETRIC


def screwdriver(rng: Generator) -> Shape:
    """A handle and a shaft along z; its symmetry is common to the handle's section and the tip."""
    R, grip, shaft = rng.uniform(0.012, 0.018), rng.uniform(0.08, 0.11), rng.uniform(0.07, 0.13)
    curve = rounded(
        [
            (0, 0),
            (R * 0.8, 0),
            (R, grip * 0.25),
            (R * 0.95, grip * 0.7),
            (R * 0.6, grip * 0.9),
            (R * 0.8, grip),
            (0, grip),
        ],
        0.008,
    )
    kind = rng.choice(4)
    section = (circle(40), fluted(40, 4, 0.09), fluted(48, 6, 0.09), superellipse(40, 2.5, 0.7))[kind]
    r = rng.uniform(0.0025, 0.004)
    if kind == 3:
        s = np.array([0, 0.8, 0.92, 1.0])
        half = np.stack([r * np.array([1, 1, 1.5, 1.4]), r * np.array([1, 1, 0.4, 0.25])], axis=1)
        z = np.broadcast_to((grip - 0.004 + (shaft + 0.004) * s)[:, None, None], (4, 16, 1))
        rings = np.concatenate([circle(16)[None] * half[:, None], z], axis=-1)
        blade = loft(rings, segment_hulls(rings, 2))
        return join([revolve(curve, section), blade]), cyclic(2)
    tip = revolve(
        [(0, grip - 0.004), (r, grip - 0.004), (r, grip + shaft - 0.006), (r * 0.3, grip + shaft), (0, grip + shaft)],
        circle(24) if kind != 1 else superellipse(40, 2.0),
    )
    return join([revolve(curve, section), tip]), cyclic((0, 4, 6)[kind])


def dumbbell(rng: Generator) -> Shape:
    """Two heads on a bar along z, round or hexagonal; symmetric upside down."""
    R, head, bar, half = (
        rng.uniform(0.03, 0.045),
        rng.uniform(0.035, 0.055),
        rng.uniform(0.011, 0.015),
        rng.uniform(0.045, 0.06),
    )
    grip = revolve(
        [(0, -half - 0.004), (bar, -half - 0.004), (bar * 1.1, 0), (bar, half + 0.004), (0, half + 0.004)], circle(48)
    )
    hexagonal = rng.random() < 0.5
    curve = rounded([(0, half), (R, half), (R, half + head), (0, half + head)], 0.006)
    weight = revolve(curve, polygon(6, 2)) if hexagonal else revolve(curve)
    return join([grip, weight, weight.moved(rotation=np.diag([1.0, -1.0, -1.0]))]), dihedral(6 if hexagonal else 0)


def block(rng: Generator) -> Shape:
    """A toy block: cube, brick, studded brick, prism, cylinder or arch."""
    kind, a = rng.choice(6), rng.uniform(0.055, 0.08)
    bevel = a * 0.04
    if kind == 0:
        return extrude(
            rectangle(a, a), a
        ), cube()  # no bevel: it exists on two sides only and would break the symmetry
    if kind == 1:
        return extrude(rectangle(a, a * rng.uniform(0.6, 0.8)), a * rng.uniform(1.3, 2.0), bevel), dihedral(2)
    if kind == 2:
        columns = int(rng.integers(2, 5))
        pitch = a / 2
        stud = revolve(
            rounded([(0, 0), (pitch * 0.32, 0), (pitch * 0.32, pitch * 0.3), (0, pitch * 0.3)], 0.001), circle(16)
        )
        brick = extrude(rectangle(columns * pitch, 2 * pitch), pitch * 1.2, bevel / 2)
        places = [
            ((i - (columns - 1) / 2) * pitch, (j - 0.5) * pitch, pitch * 1.19) for i in range(columns) for j in (0, 1)
        ]
        return join([brick, *(stud.moved(place) for place in places)]), cyclic(4 if columns == 2 else 2)
    if kind == 3:
        sides = int(rng.choice([3, 5, 6]))
        group = dihedral(sides)
        return extrude(polygon(sides) * a * 0.65, a * rng.uniform(0.5, 1.6), bevel), group
    if kind == 4:
        R, H = a * 0.5, a * rng.uniform(0.6, 1.6)
        return revolve(rounded([(0, 0), (R, 0), (R, H), (0, H)], bevel)), dihedral(0)
    span, depth = a * 1.5, a * rng.uniform(0.35, 0.5)
    angle = np.linspace(0, np.pi, 13)
    inner = np.stack([span * 0.3 * np.cos(angle), span * 0.3 * np.sin(angle)], axis=1)
    far = np.maximum(np.abs(np.cos(angle)) / (span * 0.5), np.abs(np.sin(angle)) / (span * 0.5))
    outer = np.stack([np.cos(angle) / far, np.sin(angle) / far], axis=1)
    section = np.stack([inner, outer, outer, inner], axis=1)
    y = np.broadcast_to(np.array([-1, -1, 1, 1]) * depth / 2, (13, 4))
    rings = np.stack([section[..., 0], y, section[..., 1]], axis=-1)
    return loft(rings, segment_hulls(rings, 6)), cyclic(2)


def pyramid(rng: Generator) -> Shape:
    """A pyramid or cone, pointed or truncated; some are regular tetrahedra."""
    kind, R = rng.choice(6), rng.uniform(0.04, 0.065)
    if kind == 5:
        H = R * np.sqrt(2)
        base = polygon(3) * R
        rings = np.concatenate([base, np.zeros((3, 1))], axis=1)[None] * np.ones((2, 1, 1))
        rings[1] = rings[0] * 1e-3 + [0, 0, H * (1 - 1e-3)]
        faces = [base[i] + base[j] for i, j in ((0, 1), (1, 2), (2, 0))]
        threes = [
            (0.0, 0.0, 1.0),
            *(
                (2 * np.sqrt(2) / 3 * np.cos(w), 2 * np.sqrt(2) / 3 * np.sin(w), -1 / 3)
                for w in 2 * np.pi * np.arange(3) / 3
            ),
        ]
        twos = []
        for f in faces:
            low = np.array([f[0] / 2, f[1] / 2, -H / 4])
            twos.append(low / np.linalg.norm(low))
        axes = [*((axis, 3) for axis in threes), *((axis, 2) for axis in twos)]
        group = tuple(SymmetryAxis((float(x), float(y), float(z)), order) for (x, y, z), order in axes)
        return loft(rings, [rings.reshape(-1, 3)], end_tip=(0, 0, H)), group
    H = R * rng.uniform(1.1, 2.2)
    top = R * rng.choice([0.02, 0.02, 0.3, 0.5])
    profile = [(0, 0), (R, 0), (top, H), (0, H)]
    if kind == 4:
        return revolve(profile), cyclic(0)
    sides = (3, 4, 5, 6)[kind]
    return revolve(profile, polygon(sides, 2)), cyclic(sides)


def ring(rng: Generator) -> Shape:
    """A torus, a flat washer, a nut with flat sides, or a square frame."""
    kind, R = rng.choice(4), rng.uniform(0.035, 0.075)
    hole = R * rng.uniform(0.5, 0.75)
    if kind == 0:
        return hoop(circle(48) * hole, circle(48) * R, R - hole, 12, bulge=3), dihedral(0)
    if kind == 1:
        return hoop(circle(48) * hole, circle(48) * R, rng.uniform(0.008, 0.02), 12), dihedral(0)
    if kind == 2:
        sides = int(rng.choice([5, 6]))
        count = sides * 8
        return hoop(circle(count) * hole * 0.75, polygon(sides, 8) * R, rng.uniform(0.012, 0.03), 2 * sides), dihedral(
            sides
        )
    outside = polygon(4, 3) * R
    return hoop(outside * rng.uniform(0.55, 0.75), outside, rng.uniform(0.008, 0.02), 4), dihedral(4)


TOOLS = {f.__name__: f for f in (knife, spoon, hammer, screwdriver, dumbbell, block, pyramid, ring)}
