"""Hands with forearms, made of tubes, as rigid objects: bare or sleeved human arms, and robot arms with a gripper.

Arm frame: origin at the palm's centre, x from the wrist to the fingers, the palm faces -z. The origin is the object's
centre X, so that motions of an arm are stated at its hand and not at a point of the forearm outside the image.
"""

from __future__ import annotations

import colorsys
from dataclasses import dataclass

import cv2
import numpy as np

from objectflow.synth.objects.model import ObjectModel
from objectflow.synth.objects.shapes.outline import rounded, superellipse
from objectflow.synth.objects.shapes.solid import Solid, join
from objectflow.synth.objects.shapes.sweep import tube
from objectflow.synth.scenes.texture_patterns import value_noise
from objectflow.synth.scenes.textures import TextureSpec, draw_texture
from objectflow.typing import Float64Array, UInt8Array

TEXTURE = 128
"""Side length of an arm's texture, pixels; skin is in its left half, the sleeve in its right half."""
ROBOTS = 0.12
"""Share of arms that are robot arms, 0..1."""
SLEEVES = ("plain", "noise", "stripes", "fabric", "checker")
"""Texture kinds of sleeves."""
_FINGER_Y = (-0.030, -0.010, 0.011, 0.031)
"""Lateral positions of the fingers, metres."""
_FINGER_LENGTH = (0.064, 0.078, 0.082, 0.074)
"""Lengths of the fingers, metres."""


@dataclass(frozen=True, eq=False)
class Arm:
    """A hand with its arm.

    Attributes:
        model: the rigid object; its hulls are not used in simulations.
        grip: (3,) the point between thumb and fingertips, metres, arm frame.
        shoulder: (3,) the far end of the arm, metres, arm frame.
    """

    model: ObjectModel
    grip: Float64Array
    shoulder: Float64Array


def build_arm(number: int) -> Arm:
    """Build the arm of a number; the same number always gives the same arm."""
    rng = np.random.default_rng(np.random.SeedSequence([0x41524D, number]))
    robot = bool(rng.random() < ROBOTS)
    hand, grip = _gripper(rng) if robot else _hand(rng)
    limb, sleeve, shoulder = _limb(rng, robot)
    solid = join([_in_half(hand, 0), _in_half(limb, 0), _in_half(sleeve, 1)])
    if rng.random() < 0.5:  # a left hand
        mirror = np.array([1.0, -1.0, 1.0])
        faces = np.ascontiguousarray(solid.faces[:, ::-1])
        solid = Solid(solid.vertices * mirror, faces, solid.uv, tuple(part * mirror for part in solid.parts))
        grip, shoulder = grip * mirror, shoulder * mirror
    size = float(rng.uniform(0.85, 1.1))
    name = f"arm-{number:06d}"
    model = ObjectModel(
        category="robot-arm" if robot else "arm",
        name=name,
        vertices=solid.vertices * size,
        faces=solid.faces,
        uv=solid.uv,
        parts=tuple(part * size for part in solid.parts),
        symmetry=(),
        texture=_draw_skin_and_sleeve(rng, robot),
    )
    return Arm(model, grip * size, shoulder * size)


def _hand(rng: np.random.Generator) -> tuple[Solid, Float64Array]:
    """A palm, four fingers and a thumb: flat, curled as around a mug, or closed to a fist."""
    curl = float(
        rng.choice([rng.uniform(0.05, 0.3), rng.uniform(0.4, 0.75), rng.uniform(0.9, 1.25)], p=(0.3, 0.55, 0.15))
    )
    spread = float(rng.uniform(0.0, 0.12))
    along = np.array([-0.052, -0.045, -0.02, 0.02, 0.042, 0.05])
    palm_path = np.column_stack([along, np.zeros(6), np.zeros(6)])
    palm = tube(palm_path, [0.018, 0.030, 0.036, 0.042, 0.041, 0.03], superellipse(14, 2.6, 0.38), parts=1)
    solids, tips = [palm], []
    for y, length in zip(_FINGER_Y, _FINGER_LENGTH, strict=True):
        heading = spread * y / 0.03
        path, angle = [np.array([0.036, y, 0.0])], 0.0
        for share in (0.12, 0.42, 0.27, 0.19):
            step = length * share * np.array([np.cos(angle) * np.cos(heading), np.sin(heading), -np.sin(angle)])
            path.append(path[-1] + step)
            angle += curl * float(rng.uniform(0.85, 1.15))
        solids.append(_finger(np.array(path), 0.0085))
        tips.append(path[-1])
    bend = 0.5 * min(curl, 0.8)
    out, forward = 0.75 - bend, 0.55 + 0.3 * bend
    base = np.array([-0.02, 0.028, -0.006])
    middle = base + 0.05 * np.array([forward, out, -0.25 - bend])
    tip = middle + 0.035 * np.array([0.9, -0.2 * bend, -0.2 - bend])
    solids.append(_finger(np.stack([base, (base + middle) / 2, middle, tip]), 0.0105))
    return join(solids), np.asarray((np.mean(tips, axis=0) + tip) / 2)


def _finger(path: Float64Array, radius: float) -> Solid:
    """A tube along joints (N, 3) with a round tip."""
    curve = rounded(path, 0.01)
    end = curve[-1] - curve[-2]
    end /= np.linalg.norm(end)
    curve = np.concatenate([curve, [curve[-1] + 0.6 * radius * end, curve[-1] + 0.9 * radius * end]])
    radii = np.concatenate([np.linspace(radius, 0.85 * radius, len(curve) - 2), [0.6 * radius, 0.25 * radius]])
    return tube(curve, radii, superellipse(8, 2.0), up=(0.05, 0.98, 0.2), parts=1)


def _gripper(rng: np.random.Generator) -> tuple[Solid, Float64Array]:
    """A parallel gripper with two fingers."""
    opening = float(rng.uniform(0.012, 0.045))
    body = tube([(-0.06, 0, 0), (-0.055, 0, 0), (0.03, 0, 0)], [0.05, 0.055, 0.055], superellipse(12, 6, 0.5), parts=1)
    fingers = [tube([(0.02, y, 0), (0.1, y, 0)], 0.012, superellipse(8, 6, 0.8), parts=1) for y in (-opening, opening)]
    return join([body, *fingers]), np.array([0.09, 0.0, 0.0])


def _limb(rng: np.random.Generator, robot: bool) -> tuple[Solid, Solid, Float64Array]:
    """The arm from the wrist to the shoulder, the sleeve over it, and the shoulder; a robot's sleeve is a link."""
    elbow = np.array([-float(rng.uniform(0.27, 0.34)), 0.0, 0.0])
    bend = float(rng.uniform(0.2, 1.2))
    turn = float(rng.uniform(-0.7, 0.7))
    back = np.array([-np.cos(bend), np.sin(bend) * np.sin(turn), np.sin(bend) * np.cos(turn)])
    shoulder = elbow + float(rng.uniform(0.3, 0.6)) * back
    thick = 1.15 if robot else float(rng.uniform(0.85, 1.15))
    line = rounded(np.stack([[-0.035, 0, 0], [-0.09, 0, 0], elbow, shoulder]), [0.02, 0.09], steps=5)
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    radius = thick * np.interp(along, [0.0, 0.05, 0.12, 0.25, 0.45], [0.031, 0.028, 0.034, 0.043, 0.05])
    section = superellipse(14, 2.0, 0.82)
    limb = tube(line, radius, section, up=(0.0, 1.0, 0.05), parts=2)
    cuff = float(
        rng.choice([rng.uniform(0.0, 0.05), rng.uniform(0.08, 0.2), rng.uniform(0.28, 0.4)], p=(0.5, 0.25, 0.25))
    )
    start = np.clip(cuff + 0.01, 0.01, along[-1] - 0.05)
    marks = np.unique(np.concatenate([[start, start + 0.012], along[along > start + 0.02]]))
    path = np.column_stack([np.interp(marks, along, line[:, axis]) for axis in range(3)])
    wide = np.interp(marks, along, radius) * float(rng.uniform(1.15, 1.4)) + 0.004
    wide *= 1 + float(rng.uniform(0.0, 0.08)) * np.sin(np.arange(len(wide)) * 2.1)  # folds
    return limb, tube(path, wide, section, up=(0.0, 1.0, 0.05), parts=2), shoulder


def _in_half(solid: Solid, half: int) -> Solid:
    """The solid with its texture coordinates moved to the left (0) or right (1) half of the texture."""
    uv = np.clip(solid.uv, 0, 1)
    return Solid(
        solid.vertices, solid.faces, np.stack([0.02 + 0.46 * uv[:, 0] + 0.5 * half, uv[:, 1]], axis=1), solid.parts
    )


def _draw_skin_and_sleeve(rng: np.random.Generator, robot: bool) -> UInt8Array:
    if robot:
        grey = float(rng.choice([rng.uniform(0.1, 0.3), rng.uniform(0.75, 0.95)]))
        skin, sleeve = _rgb(0.6, 0.05, grey), _rgb(float(rng.random()), float(rng.uniform(0, 0.7)), 0.85)
        kind = "plain"
    else:
        tone = float(rng.uniform(0, 1)) ** 1.5  # light skin is more frequent
        skin = _rgb(float(rng.uniform(0.03, 0.075)), 0.28 + 0.3 * tone, 0.92 - 0.55 * tone)
        sleeve = _rgb(float(rng.random()), float(rng.uniform(0.0, 0.8)), float(rng.uniform(0.1, 0.95)))
        kind = str(rng.choice(SLEEVES, p=(0.5, 0.15, 0.12, 0.13, 0.1)))
    second = tuple(int(c * rng.uniform(0.5, 0.9)) for c in sleeve)
    spec = TextureSpec(
        kind, int(rng.integers(2**31)), (sleeve, (second[0], second[1], second[2]), (230, 230, 230)),
        int(rng.integers(2, 6)),
    )  # fmt: skip
    cloth = cv2.resize(draw_texture(spec, TEXTURE), (TEXTURE // 2, TEXTURE), interpolation=cv2.INTER_AREA)
    cloth = cloth * (0.85 + 0.15 * value_noise(rng, TEXTURE, [(6, 4), (14, 10)]))[:, : TEXTURE // 2, None]
    blotches = value_noise(rng, TEXTURE, [(5, 5), (20, 20), (60, 60)])[:, : TEXTURE // 2, None]
    bare = np.array(skin) * (0.88 + 0.12 * blotches)
    both = np.rint(np.concatenate([bare, cloth], axis=1)).clip(0, 255)
    return np.asarray(both, dtype=np.uint8)


def _rgb(hue: float, saturation: float, value: float) -> tuple[int, int, int]:
    red, green, blue = (round(255 * part) for part in colorsys.hsv_to_rgb(hue, saturation, value))
    return red, green, blue
