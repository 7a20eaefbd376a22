"""Household objects: box, book, phone, remote, lamp, cap, helmet, camera, clock, candle."""

from __future__ import annotations

import numpy as np
from numpy.random import Generator

from objectflow.synth.objects.shapes.groups import ASYMMETRIC, Group, X, cube, cyclic, dihedral
from objectflow.synth.objects.shapes.outline import circle, fluted, rectangle, rounded, superellipse
from objectflow.synth.objects.shapes.revolve import revolve, vessel
from objectflow.synth.objects.shapes.solid import Solid, join, loft
from objectflow.synth.objects.shapes.sweep import extrude, segment_hulls, tube
from objectflow.typing import Float64Array

Shape = tuple[Solid, Group]

UPSIDE_DOWN = np.diag([1.0, -1.0, -1.0])
"""Half a turn about x."""
TO_Y = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""Rotates the z axis to the y axis."""


def _cuboid(x: float, y: float, z: float, at: tuple[float, float, float]) -> Solid:
    """A box of the given size with sharp edges and its centre at `at`, metres."""
    return extrude(rectangle(x, y), z).moved((at[0], at[1], at[2] - z / 2))


def box(rng: Generator) -> Shape:
    """A closed box (oblong, square or a cube), or an open hollow one."""
    kind, a = rng.choice(4, p=[0.4, 0.2, 0.15, 0.25]), rng.uniform(0.06, 0.13)
    b, c = a * rng.uniform(0.35, 0.75), a * rng.uniform(1.25, 1.9)
    if kind == 0:
        return extrude(rectangle(a, b), c), dihedral(2)
    if kind == 1:
        return extrude(rectangle(a, a), min(c, 0.2) if rng.random() < 0.5 else b), dihedral(4)
    if kind == 2:
        return extrude(rectangle(a, a), a), cube()
    c, t = min(c, 0.2), rng.uniform(0.003, 0.005)
    walls = [
        (c, t, (0, (a - t) / 2)),
        (c, t, (0, -(a - t) / 2)),
        (t, a - 2 * t, ((c - t) / 2, 0)),
        (t, a - 2 * t, (-(c - t) / 2, 0)),
    ]
    outer, inner = rectangle(c, a), rectangle(c - 2 * t, a - 2 * t)
    levels = [(outer, 0.0), (outer, b), (inner, b), (inner, 0.006)]
    rings = np.stack([np.column_stack([outline, np.full(4, z)]) for outline, z in levels])
    parts = [np.concatenate([rings[0], rings[0] + [0, 0, 0.006]])]
    parts += [_cuboid(x, y, b, (u, v, b / 2)).vertices for x, y, (u, v) in walls]
    return loft(rings, parts), cyclic(2)


def book(rng: Generator) -> Shape:
    """Two covers and a spine around inset pages; symmetric under half a turn about the middle of the spine."""
    width, height, thick = rng.uniform(0.1, 0.17), rng.uniform(0.16, 0.24), rng.uniform(0.018, 0.045)
    cover, back = rng.uniform(0.0025, 0.004), rng.uniform(0.006, 0.01)
    # The covers overlap the spine slightly, because two solids must not share an edge.
    lid = extrude(rectangle(width - 0.002, height), cover).moved((0.001, 0, thick / 2 - cover))
    bend = np.linspace(np.pi / 2, -np.pi / 2, 9)
    outline = np.stack([-width / 2 - 0.25 * thick * np.cos(bend), thick / 2 * np.sin(bend)], axis=1)
    outline = np.concatenate([outline, outline[::-1] * [0, 1] + [-width / 2 + cover, 0]])
    spine = extrude(outline[:, ::-1], height)
    turn = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
    spine = spine.moved((0, -height / 2, 0), turn)
    pages = _cuboid(
        width - back - cover / 2, height - 2 * back, thick - cover, (-back / 2 - cover / 4 + cover / 2, 0, 0)
    )
    return join([lid, lid.moved(rotation=UPSIDE_DOWN), spine, pages]), cyclic(2, X)


def phone(rng: Generator) -> Shape:
    """A flat slab with or without a camera bump in a corner, or a handset with an aerial."""
    x, y, z = rng.uniform(0.066, 0.08), rng.uniform(0.135, 0.165), rng.uniform(0.008, 0.011)
    kind = rng.choice(3, p=[0.5, 0.2, 0.3])
    if kind == 2:
        x, y, z = rng.uniform(0.045, 0.055), rng.uniform(0.1, 0.14), rng.uniform(0.017, 0.024)
        body = extrude(rectangle(x, y, 0.012), z, 0.003)
        aerial = revolve(rounded([(0, 0), (0.004, 0), (0.0035, 0.035), (0, 0.035)], 0.002), circle(16))
        keys = [
            extrude(rectangle(x * 0.2, 0.008, 0.002), 0.002).moved((x * 0.27 * i, -y * 0.1 - 0.012 * j, z - 0.0005))
            for i in (-1, 0, 1)
            for j in range(4)
        ]
        screen = extrude(rectangle(x * 0.8, y * 0.3, 0.002), 0.0015).moved((0, y * 0.2, z - 0.0005))
        return join([body, screen, *keys, aerial.moved((x * 0.32, y / 2 - 0.004, z / 2), TO_Y)]), ASYMMETRIC
    body = extrude(rectangle(x, y, 0.01), z, z * 0.25)
    if kind == 1:
        return body, dihedral(2)
    side, high = rng.uniform(0.026, 0.036), rng.uniform(0.002, 0.0035)
    bump = extrude(rectangle(side, side * rng.uniform(1, 1.2), 0.006), high + 0.001, 0.0005)
    lens = extrude(circle(20) * side * 0.2, 0.002)
    lenses = [lens.moved((u, v, high)) for u, v in ((-side * 0.22, side * 0.2), (side * 0.22, -side * 0.2))]
    at = (-x / 2 + side / 2 + 0.004, y / 2 - side * 0.6 - 0.004, z - 0.001)
    return join([body, join([bump, *lenses]).moved(at)]), ASYMMETRIC


def remote(rng: Generator) -> Shape:
    """A long slab with a round pad near one end and rows of keys."""
    x, y, z = rng.uniform(0.038, 0.052), rng.uniform(0.13, 0.2), rng.uniform(0.014, 0.022)
    body = extrude(rectangle(x, y, x * rng.uniform(0.15, 0.4)), z, 0.003)
    high = rng.uniform(0.003, 0.0045)
    pad = revolve(rounded([(0, 0), (x * 0.34, 0), (x * 0.34, high), (0, high)], 0.001), circle(24)).moved(
        (0, y * 0.28, z - 0.001)
    )
    rows, width = int(rng.integers(2, 5)), x * 0.2
    shape = rectangle(width, width * 0.7, width * 0.2, 2) if rng.random() < 0.5 else circle(16) * width * 0.45
    key = extrude(shape, high)
    keys = [key.moved((x * 0.29 * i, y * 0.06 - x * 0.28 * j, z - 0.001)) for i in (-1, 0, 1) for j in range(rows)]
    return join([body, pad, *keys]), ASYMMETRIC


def lamp(rng: Generator) -> Shape:
    """A table lamp with a round or square shade, or a desk lamp with a bent arm."""
    kind = rng.choice(3, p=[0.45, 0.2, 0.35])
    R, H = rng.uniform(0.05, 0.075), rng.uniform(0.2, 0.32)
    if kind == 2:
        base = revolve(rounded([(0, 0), (R, 0), (R, 0.012), (0.012, 0.02), (0, 0.02)], 0.004))
        bend = rounded([(0, 0, 0.015), (-0.03, 0, H * 0.5), (0.03, 0, H * 0.85), (0.05, 0, H * 0.85)], 0.02)
        head = vessel(rounded([(0, 0), (0.018, 0), (0.028, 0.02), (0.05, 0.065)], 0.008), 0.003, wedges=10)
        tilt = rng.uniform(2.2, 2.7)
        turn = np.array([[np.cos(tilt), 0, np.sin(tilt)], [0, 1, 0], [-np.sin(tilt), 0, np.cos(tilt)]])
        return join(
            [base, tube(bend, 0.006, up=(0, 1, 0), parts=4), head.moved((0.045, 0, H * 0.86), turn)]
        ), ASYMMETRIC
    section = circle(48) if kind == 0 else superellipse(48, 8.0)
    shade_height, top = H * rng.uniform(0.35, 0.45), R * rng.uniform(0.5, 0.8)
    shade = vessel([(0, 0), (top, 0), (R * 1.1, shade_height)], 0.003, section)
    body = R * rng.uniform(0.25, 0.6)
    stem = [
        (0, 0),
        (R * 0.8, 0),
        (R * 0.8, 0.012),
        (0.012, 0.02),
        (body, H * 0.3),
        (0.01, H * 0.5),
        (0.006, H * 0.6),
        (0.006, H - 0.001),
        (0, H - 0.001),
    ]
    stand = revolve(rounded(stem, [0.003, 0.003, 0.004, 0.03, 0.02, 0.01, 0]), section)
    return join([stand, shade.moved((0, 0, H), UPSIDE_DOWN)]), cyclic(0 if kind == 0 else 4)


def _dome(R: float, H: float, t: float, section: Float64Array, flare: float = 0.0) -> Solid:
    """Half a shell, open at the bottom, with its rim at z = 0."""
    angle = np.linspace(0.25, np.pi / 2, 9)
    curve = np.stack([R * np.sin(angle), H * (1 - np.cos(angle))], axis=1)
    curve = np.concatenate([[[0, curve[0, 1]]], curve])
    if flare > 0:
        curve = np.concatenate([curve, [[R + flare, H + 0.004]]])
    return vessel(curve, t, section, wedges=8, levels=2).moved((0, 0, curve[-1, 1]), UPSIDE_DOWN)


def _brim(R: float, reach: float, *, spread: float, droop: float, aspect: float, t: float, low: float) -> Solid:
    """The crescent-shaped brim of a cap, towards +x."""
    angle = np.linspace(-spread, spread, 15)
    out = reach * np.sqrt(np.maximum(1 - (angle / spread) ** 2, 0)) + 0.002
    c, s = np.cos(angle), np.sin(angle) * aspect
    z_in = low - droop * (angle / spread) ** 2
    z_out = z_in - droop * 0.5 * out / reach
    inner = np.stack([(R - 0.004) * c, (R - 0.004) * s, z_in], axis=1)
    outer = np.stack([R * c + out * np.cos(angle * 0.6), R * s + out * np.sin(angle * 0.6) * aspect, z_out], axis=1)
    lift = np.array([0, 0, t])
    rings = np.stack([inner, outer, outer + lift, inner + lift], axis=1)
    return loft(rings, segment_hulls(rings, 4))


def cap(rng: Generator) -> Shape:
    """A cap with a brim at the front, or a knitted hat with a bobble on top."""
    R, H = rng.uniform(0.078, 0.092), rng.uniform(0.085, 0.11)
    if rng.random() < 0.25:
        bobble = rng.uniform(0.018, 0.026)
        angle = np.linspace(0, np.pi, 10)
        ball = revolve(np.stack([bobble * np.sin(angle), H + bobble * (0.6 - np.cos(angle))], axis=1), circle(24))
        roll = [(0, 0), (R * 0.5, 0), (R * 0.85, H * 0.3), (R, H * 0.72), (R + 0.006, H * 0.74), (R + 0.006, H)]
        crown = vessel(rounded(roll, [0.02, 0.02, 0.01, 0.002]), 0.004, circle(40), wedges=10, levels=2)
        return join([crown.moved((0, 0, H), UPSIDE_DOWN), ball]), cyclic(0)
    section = superellipse(40, 2.0, rng.uniform(0.85, 0.95))
    brim = _brim(
        R, rng.uniform(0.05, 0.07), spread=1.0, droop=rng.uniform(0.004, 0.02), aspect=0.9, t=0.0035, low=0.003
    )
    button = revolve(rounded([(0, -0.003), (0.008, -0.003), (0.007, 0.004), (0, 0.005)], 0.002), circle(16)).moved(
        (0, 0, H)
    )
    return join([_dome(R, H, 0.0035, section), brim, button]), ASYMMETRIC


def helmet(rng: Generator) -> Shape:
    """An oval shell with ridges along it (a cycle helmet), with a rim all round, or with a peak at the front."""
    R, H, t = rng.uniform(0.105, 0.13), rng.uniform(0.1, 0.13), rng.uniform(0.006, 0.01)
    section = superellipse(40, 2.2, rng.uniform(0.76, 0.86))
    kind = rng.choice(3)
    if kind == 0:
        angle = np.linspace(0.35, np.pi - 0.35, 13)
        ridges = []
        for place in (-0.3, 0.0, 0.3):
            width = np.sqrt(1 - place**2)
            path = np.stack(
                [R * width * np.cos(angle), np.full(13, R * 0.8 * place), (H - 0.004) * width * np.sin(angle)], axis=1
            )
            ridges.append(tube(path, 0.009, up=(0, 1, 0), parts=3))
        return join([_dome(R, H, t, section), *ridges]), cyclic(2)
    if kind == 1:
        return _dome(R, H, t, section, flare=rng.uniform(0.015, 0.03)), cyclic(2)
    peak = _brim(R, rng.uniform(0.03, 0.05), spread=1.1, droop=0.01, aspect=0.8, t=0.005, low=0.008)
    return join([_dome(R, H, t, section), peak]), ASYMMETRIC


def camera(rng: Generator) -> Shape:
    """A body with a stepped lens at the front, a hump above it, a button and a dial."""
    x, y, z = rng.uniform(0.1, 0.14), rng.uniform(0.03, 0.05), rng.uniform(0.065, 0.09)
    body = extrude(rectangle(x, y, y * 0.3), z, 0.004)
    aside, R, reach = x * rng.uniform(-0.05, 0.12), z * rng.uniform(0.36, 0.44), rng.uniform(0.03, 0.07)
    steps = [(0, -0.004), (R, -0.004), (R, reach * 0.45), (R * 0.88, reach * 0.5), (R * 0.88, reach)]
    glass = [(R * 0.72, reach), (R * 0.6, reach - 0.006), (0, reach - 0.004)]
    lens = revolve([*steps, *glass], circle(32), [*steps, (0, reach)])
    hump = extrude(rectangle(x * 0.3, y * 0.8, 0.004), z * 0.25, 0.003).moved((aside, 0, z - 0.004))
    button = extrude(circle(16) * 0.006, 0.007).moved((-x * 0.36, 0, z - 0.002))
    dial = extrude(circle(24) * 0.009, 0.008).moved((x * 0.34, 0, z - 0.002))
    return join([body, lens.moved((aside, y / 2, z * 0.46), TO_Y), hump, button, dial]), ASYMMETRIC


def clock(rng: Generator) -> Shape:
    """A wall clock (round or square), an alarm clock with bells and feet, or a mantel clock with an arched top."""
    kind, R, depth = rng.choice(4, p=[0.3, 0.2, 0.3, 0.2]), rng.uniform(0.07, 0.13), rng.uniform(0.025, 0.04)
    if kind <= 1:
        outside = [(R, 0), (R, depth), (R * 0.9, depth)]
        curve = rounded([(0, 0), *outside, (R * 0.87, depth * 0.6), (0, depth * 0.6)], 0.004)
        wedges = [(0, 0), (R, 0), (R, depth * 0.62), (0, depth * 0.62)]
        section = circle(48) if kind == 0 else superellipse(48, 8.0)
        shell = revolve(curve, section, wedges)
        rim = vessel([(0, 0), (R, 0), (R, depth)], R * 0.12, section).parts[1:]
        return Solid(shell.vertices, shell.faces, shell.uv, (*shell.parts, *rim)), cyclic(0 if kind == 0 else 4)
    if kind == 2:
        R = R * 0.6
        outside = [(0, 0), (R * 0.9, 0), (R, 0.006), (R, depth), (R * 0.9, depth)]
        body = revolve([*outside, (R * 0.86, depth - 0.006), (0, depth - 0.006)], None, [*outside, (0, depth)])
        angle = np.linspace(0, np.pi / 2, 6)
        bell = revolve(
            np.concatenate([[[0, 0]], R * 0.36 * np.stack([np.cos(angle), np.sin(angle)], axis=1)]), circle(24)
        )
        foot = revolve([(0, -0.024), (0.004, -0.024), (0.006, 0), (0, 0)], circle(12))
        pieces = [body.moved((0, -depth / 2, 0), TO_Y)]
        for side in (-1, 1):
            for part, lean, sign in ((bell, side * 0.62, 1.0), (foot, side * -0.62, -1.0)):
                turn = np.array([[np.cos(lean), 0, np.sin(lean)], [0, 1, 0], [-np.sin(lean), 0, np.cos(lean)]])
                pieces.append(part.moved(turn @ [0, 0, sign * R * 0.98], turn))
        return join(pieces), ASYMMETRIC
    bend = np.linspace(0, np.pi, 15)
    arch = np.concatenate([[[-R, -R], [R, -R]], R * np.stack([np.cos(bend), 0.7 * np.sin(bend)], axis=1)])
    body = extrude(arch, depth * 1.6, 0.002).moved((0, depth * 0.8, 0), TO_Y.T)
    face = revolve(
        [(0, 0), (R * 0.7, 0), (R * 0.7, 0.012), (R * 0.6, 0.012), (R * 0.58, 0.006), (0, 0.006)],
        None,
        [(0, 0), (R * 0.7, 0), (R * 0.7, 0.012), (0, 0.012)],
    )
    foot = _cuboid(2.3 * R, depth * 2.2, 0.014, (0, 0, -R - 0.005))
    return join([body, face.moved((0, depth * 0.8 - 0.003, -R * 0.1), TO_Y), foot]), ASYMMETRIC


def candle(rng: Generator) -> Shape:
    """A pillar with a wick: round, square or twisted, or in a holder with a ring as its handle."""
    kind, R, H = rng.choice(4), rng.uniform(0.018, 0.035), rng.uniform(0.08, 0.16)
    wick = revolve([(0, H - 0.006), (0.0018, H - 0.006), (0.0014, H + 0.01), (0, H + 0.01)], circle(24))
    curve = rounded([(0, 0), (R, 0), (R, H), (R * 0.7, H), (R * 0.5, H - 0.003), (0, H - 0.003)], [0.002, 0.003, 0, 0])
    hull = [(0, 0), (R, 0), (R, H), (0, H)]
    if kind == 0:
        return join([revolve(curve, None, hull), wick]), cyclic(0)
    if kind == 1:
        return join([revolve(curve, superellipse(40, 9.0), hull), wick]), cyclic(4)
    if kind == 2:
        lobes, rate = int(rng.choice([4, 6])), rng.uniform(4, 9)
        outline = fluted(48, lobes, 0.09)

        def section(z: float) -> Float64Array:
            c, s = np.cos(rate * z / H), np.sin(rate * z / H)
            return np.asarray(outline @ np.array([[c, s], [-s, c]]))

        wall = [(R, z) for z in np.linspace(0.0, H, 17)]
        solid = revolve([(0, 0), *wall, (0, H)], section, hull)
        rings = [np.column_stack([R * 1.05 * circle(24), np.full(24, z)]) for z in (0.0, H)]
        return join([Solid(solid.vertices, solid.faces, solid.uv, (np.concatenate(rings),)), wick]), cyclic(lobes)
    R, H = R * 0.6, H * 0.8
    wick = wick.moved((0, 0, H - H / 0.8))
    dish = vessel(rounded([(0, 0), (0.035, 0), (0.052, 0.016)], 0.006), 0.003)
    bend = np.linspace(2.3, -2.3, 15)
    loop = np.stack([0.06 + 0.016 * np.cos(bend), 0 * bend, 0.014 + 0.016 * np.sin(bend)], axis=1)
    body = revolve(rounded([(0, 0.002), (R, 0.002), (R, H), (R * 0.5, H), (0, H)], 0.003))
    return join([dish, body, wick, tube(loop, 0.0035, up=(0, 1, 0), parts=6)]), ASYMMETRIC


HOUSEHOLD = {f.__name__: f for f in (box, book, phone, remote, lamp, cap, helmet, camera, clock, candle)}
