"""Tableware: bottle, bowl, can, mug, cup, jar, plate, pot, pan, basket."""

from __future__ import annotations

import numpy as np
from numpy.random import Generator

from objectflow.synth.objects.shapes.groups import ASYMMETRIC, Group, cyclic, dihedral
from objectflow.synth.objects.shapes.outline import circle, fluted, polygon, rounded, superellipse
from objectflow.synth.objects.shapes.revolve import revolve, vessel
from objectflow.synth.objects.shapes.solid import Solid, join
from objectflow.synth.objects.shapes.sweep import tube
from objectflow.typing import Float64Array

Shape = tuple[Solid, Group]

HALF_TURN = np.diag([-1.0, -1.0, 1.0])
"""Half a turn about z."""


def bottle(rng: Generator) -> Shape:
    """Body, shoulder, neck and cap; the section is round, square or flat."""
    kind = rng.choice(3, p=[0.6, 0.2, 0.2])
    R, H = rng.uniform(0.028, 0.042), rng.uniform(0.15, 0.30)
    neck = R * rng.uniform(0.3, 0.45)
    shoulder, throat = H * rng.uniform(0.5, 0.66), H * rng.uniform(0.74, 0.84)
    cap, cap_height = neck * rng.uniform(1.12, 1.3), rng.uniform(0.014, 0.024)
    waist = R * (1 - rng.choice([0.0, 0.12]))
    profile = [(0, 0), (R, 0), (R, 0.25 * shoulder), (waist, 0.5 * shoulder), (R, 0.75 * shoulder), (R, shoulder)]
    profile += [(neck, throat), (neck, H - cap_height), (cap, H - cap_height), (cap, H), (0, H)]
    curve = rounded(profile, [0.004, 0.02, 0.02, 0.02, 0.03, 0.012, 0, 0.001, 0.002])
    if kind == 0:
        return revolve(curve), cyclic(0)
    body = superellipse(40, 6.0) if kind == 1 else superellipse(40, 2.6, 0.55)

    def section(z: float) -> Float64Array:
        roundness = float(np.clip((z - shoulder) / (throat - shoulder), 0, 1))
        return (1 - roundness) * body + roundness * circle(40)

    return revolve(curve, section), cyclic(4 if kind == 1 else 2)


def _bowl_curve(foot: float, R: float, H: float, points: int = 9) -> Float64Array:
    """(N, 2) outer profile of a bowl: a foot, then a quarter of an ellipse up to the rim, metres."""
    t = np.linspace(0, np.pi / 2, points)
    return np.concatenate([[[0, 0]], np.stack([foot + (R - foot) * np.sin(t), H * (1 - np.cos(t))], axis=1)])


def bowl(rng: Generator) -> Shape:
    """A half shell, sometimes with a fluted wall."""
    R = rng.uniform(0.05, 0.085)
    curve = _bowl_curve(R * rng.uniform(0.35, 0.5), R, R * rng.uniform(0.5, 0.95))
    thickness = rng.uniform(0.003, 0.005)
    lobes = int(rng.choice([0, 0, 0, 5, 6, 8]))
    if lobes == 0:
        return vessel(curve, thickness, circle(40), wedges=10, levels=2), cyclic(0)
    wedges = 2 * lobes if lobes < 8 else lobes
    section = fluted(4 * wedges if lobes < 8 else 48, lobes, rng.uniform(0.06, 0.08))
    return vessel(curve, thickness, section, wedges, levels=2 if lobes == 5 else 1), cyclic(lobes)


def can(rng: Generator) -> Shape:
    """A tin that is symmetric upside down, or a drink can with a narrower top."""
    R = rng.uniform(0.027, 0.042)
    r = R - 0.003
    if rng.random() < 0.5:
        H = rng.uniform(0.05, 0.13)
        end = [(R, 0.004), (R - 0.0012, 0.006)]
        curve = [(0, 0.003), (r - 0.001, 0.003), (r, 0), (R, 0), *end]
        curve += [(x, H - z) for x, z in reversed(curve)]
        return revolve(curve, hull_profile=[(0, 0), (R, 0), (R, H), (0, H)]), dihedral(0)
    H = rng.uniform(0.1, 0.16)
    neck = R * rng.uniform(0.76, 0.85)
    outside = [(R * 0.78, 0), (R, 0.01), (R, H - 0.016), (neck, H - 0.004), (neck, H)]
    curve = [(0, 0.006), (R * 0.68, 0.003), *outside, (neck - 0.003, H), (neck - 0.004, H - 0.004), (0, H - 0.004)]
    return revolve(curve, hull_profile=[(0, 0), *outside, (0, H)]), cyclic(0)


def _ear(wall: Float64Array, heights: tuple[float, float], reach: float, radius: float, parts: int = 5) -> Solid:
    """A handle in the x-z plane between two heights of a wall, whose profile is (N, 2) of (r, z) with increasing z."""
    angle = np.linspace(np.pi / 2, -np.pi / 2, 13)
    bend = np.sign(np.cos(angle)) * np.abs(np.cos(angle)) ** 0.7
    low, high = heights
    z = (low + high) / 2 + (high - low) / 2 * np.sin(angle)
    foot, top = np.interp(heights, wall[:, 1], wall[:, 0])
    path = np.stack([foot + (top - foot) * (z - low) / (high - low) + reach * bend, 0 * z, z], axis=1)
    return tube(path, radius, superellipse(12, 2.4, 1.3)[:, ::-1], up=(0, 1, 0), parts=parts)


def mug(rng: Generator) -> Shape:
    """A vessel with one handle."""
    R, H, t = rng.uniform(0.034, 0.046), rng.uniform(0.08, 0.115), rng.uniform(0.0035, 0.005)
    foot = R * rng.uniform(0.8, 1.0)
    curve = rounded([(0, 0), (foot, 0), (foot + (R - foot) * 0.6, H * 0.4), (R, H)], [0.006, 0.02])
    heights = (H * rng.uniform(0.2, 0.3), H * rng.uniform(0.72, 0.85))
    handle = _ear(curve - [t / 2, 0], heights, rng.uniform(0.024, 0.034), rng.uniform(0.004, 0.006))
    return join([vessel(curve, t), handle]), ASYMMETRIC


def cup(rng: Generator) -> Shape:
    """A tumbler: round, with flat facets, or with two handles."""
    R, H, t = rng.uniform(0.032, 0.046), rng.uniform(0.07, 0.14), rng.uniform(0.0025, 0.004)
    foot = R * rng.uniform(0.6, 0.95)
    curve = rounded([(0, 0), (foot, 0), (R, H)], 0.004)
    kind = rng.choice(3, p=[0.5, 0.3, 0.2])
    if kind == 0:
        return vessel(curve, t), cyclic(0)
    if kind == 1:
        facets = int(rng.choice([5, 6, 8]))
        return vessel(curve, t, polygon(facets, 4), wedges=2 * facets), cyclic(facets)
    ear = _ear(curve - [t / 2, 0], (H * 0.35, H * 0.7), 0.025, 0.004, parts=4)
    return join([vessel(curve, t), ear, ear.moved(rotation=HALF_TURN)]), cyclic(2)


def jar(rng: Generator) -> Shape:
    """A bulbous vessel with a wide mouth: open, closed by a lid with a knob, or with two handles."""
    R, H, t = rng.uniform(0.04, 0.06), rng.uniform(0.08, 0.16), rng.uniform(0.003, 0.005)
    foot, mouth = R * rng.uniform(0.65, 0.9), R * rng.uniform(0.7, 0.85)
    curve = rounded([(0, 0), (foot, 0), (R, H * 0.45), (R, H * 0.6), (mouth, H * 0.88), (mouth, H)], 0.02)
    body = vessel(curve, t, circle(40), wedges=8, levels=2)
    kind = rng.choice(3, p=[0.3, 0.45, 0.25])
    if kind == 0:
        return body, cyclic(0)
    if kind == 1:
        knob = mouth * rng.uniform(0.25, 0.4)
        rim, top = mouth + 0.004, H + 0.006
        lid = [(0, H - 0.004), (mouth, H - 0.004), (rim, H - 0.002), (rim, top), (knob * 0.7, top + 0.004)]
        lid += [(knob * 0.7, top + 0.008), (knob, top + 0.012), (knob * 0.8, top + 0.02), (0, top + 0.021)]
        return join([body, revolve(lid)]), cyclic(0)
    ear = _ear(curve - [t / 2, 0], (H * 0.5, H * 0.86), 0.018 + R * 0.1, 0.0045, parts=4)
    return join([body, ear, ear.moved(rotation=HALF_TURN)]), cyclic(2)


def plate(rng: Generator) -> Shape:
    """A shallow dish: round, square with rounded corners, or oval."""
    R, H, t = rng.uniform(0.075, 0.13), rng.uniform(0.014, 0.028), rng.uniform(0.003, 0.0045)
    well = R * rng.uniform(0.5, 0.7)
    curve = rounded([(0, 0), (well, 0), (well + 0.012, H * 0.6), (R, H)], 0.008)
    kind = rng.choice(3, p=[0.6, 0.2, 0.2])
    section = (circle(48), superellipse(48, 5.0), superellipse(48, 2.0, rng.uniform(0.65, 0.8)))[kind]
    return vessel(curve, t, section), cyclic((0, 4, 2)[kind])


def pot(rng: Generator) -> Shape:
    """A deep vessel with two side handles, with or without its lid."""
    R, H, t = rng.uniform(0.065, 0.1), rng.uniform(0.06, 0.11), rng.uniform(0.003, 0.004)
    curve = rounded([(0, 0), (R * 0.97, 0), (R, H)], 0.012)
    angle = np.linspace(np.pi / 2, -np.pi / 2, 11)
    half, reach = R * rng.uniform(0.3, 0.42), rng.uniform(0.022, 0.032)
    start = np.sqrt((R * 0.985) ** 2 - half**2) - t * 0.4
    path = np.stack([start + reach * np.cos(angle) ** 0.6, half * np.sin(angle), np.full(11, H * 0.8)], axis=1)
    ear = tube(path, 0.005, parts=4)
    pieces = [vessel(curve, t), ear, ear.moved(rotation=HALF_TURN)]
    if rng.random() < 0.5:
        k = R * 0.16
        lid = [(0, H - 0.003), (R * 0.99, H - 0.003), (R + 0.003, H), (R + 0.003, H + 0.003), (R * 0.6, H + 0.012)]
        lid += [(k * 0.6, H + 0.016), (k * 0.6, H + 0.026), (k, H + 0.03), (k * 0.9, H + 0.038), (0, H + 0.04)]
        pieces.append(revolve(lid))
    return join(pieces), cyclic(2)


def pan(rng: Generator) -> Shape:
    """A shallow vessel with one long handle."""
    R, H, t = rng.uniform(0.065, 0.095), rng.uniform(0.03, 0.05), rng.uniform(0.003, 0.004)
    curve = rounded([(0, 0), (R * rng.uniform(0.75, 0.9), 0), (R, H)], 0.015)
    length, rise, width = rng.uniform(0.11, 0.15), rng.uniform(0.0, 0.03), rng.uniform(0.008, 0.012)
    s = np.linspace(0, 1, 9)
    path = np.stack([R - 0.006 + length * s, 0 * s, H * 0.78 + rise * np.sin(s * np.pi / 2)], axis=1)
    grip = superellipse(12, 2.5, rng.uniform(0.5, 0.8))
    return join([vessel(curve, t), tube(path, width * (0.75 + 0.25 * np.sin(s * np.pi)), grip, parts=3)]), ASYMMETRIC


def basket(rng: Generator) -> Shape:
    """A tapered vessel, round, square or oblong, plain or with a handle over the top."""
    R, H, t = rng.uniform(0.07, 0.11), rng.uniform(0.05, 0.09), rng.uniform(0.004, 0.006)
    curve = rounded([(0, 0), (R * rng.uniform(0.7, 0.85), 0), (R, H)], 0.008)
    kind = rng.choice(3)
    section = (circle(48), superellipse(48, 8.0), superellipse(48, 5.0, rng.uniform(0.6, 0.75)))[kind]
    body = vessel(curve, t, section)
    if rng.random() < 0.5:
        return body, cyclic((0, 4, 2)[kind])
    angle = np.linspace(0, np.pi, 17)
    arc = R * 0.985 - t * 0.4
    path = np.stack([arc * np.cos(angle), 0 * angle, H * 0.9 + rng.uniform(0.06, 0.1) * np.sin(angle) ** 0.8], axis=1)
    handle = tube(path, rng.uniform(0.004, 0.006), up=(0, 1, 0), parts=8)
    return join([body, handle]), cyclic(2)


TABLEWARE = {f.__name__: f for f in (bottle, bowl, can, mug, cup, jar, plate, pot, pan, basket)}
