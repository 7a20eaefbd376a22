"""`flow.png`: the scene flow in colours, with a legend."""

from __future__ import annotations

import math

import cv2
import numpy as np

from objectflow.frame import RgbdFrame
from objectflow.motion import SceneMotion
from objectflow.typing import BoolMask, Float64Array, UInt8Array
from objectflow.view import canvas, colors
from objectflow.view.colors import INK, NO_DEPTH

TARGET_WIDTH = 640
"""Pixels of each of the two panels at least; smaller images are enlarged by a whole factor."""

SMALLEST_RANGE = 0.01
"""Metres. Noise below it stays pale instead of filling the picture with colour."""


def draw_flow(curr: RgbdFrame, motion: SceneMotion) -> UInt8Array:
    """Draw how every point moved from the previous frame to the current one.

    Both panels show the current frame's pixels, forward in time (the negative of `scene_flow`): on the left the
    motion across the image (hue = direction, strength = length), on the right the motion in depth. Pixels without
    depth are grey; the frame's brightness shines through faintly, for orientation.

    Returns:
        (H', W', 3) uint8 RGB.
    """
    moved = -motion.scene_flow.astype(np.float64)
    known = np.asarray(np.isfinite(moved).all(axis=-1), dtype=np.bool_)
    moved = np.where(known[..., None], moved, 0)
    full = flow_range(moved[known])
    across = colors.wheel(moved[..., 0] / full, moved[..., 1] / full)
    depth = colors.diverging(moved[..., 2] / full)
    scale = math.ceil(TARGET_WIDTH / curr.camera.width)
    panels = [_panel(picture, known, curr.color, scale) for picture in (across, depth)]
    height, width = panels[0].shape[:2]
    unit = width / 640
    margin, title, legend = (round(x * unit) for x in (14, 34, 104))
    sheet = np.full((title + height + legend, 2 * width + 3 * margin, 3), 255, np.uint8)
    lefts = (margin, 2 * margin + width)
    for left, picture in zip(lefts, panels, strict=True):
        sheet[title : title + height, left : left + width] = picture
        cv2.rectangle(sheet, (left, title), (left + width - 1, title + height - 1), (173, 181, 189), 1)
    for left, words in zip(
        lefts, ("Motion across the image, previous to current frame", "Motion in depth"), strict=True
    ):
        canvas.write(sheet, words, left, title - 11 * unit, 18 * unit, INK, bold=True)
    top = title + height
    _draw_wheel(sheet, lefts[0] + 52 * unit, top + legend / 2, 38 * unit, full, unit)
    _draw_no_depth(sheet, lefts[0] + width, top + legend / 2, unit)
    _draw_bar(sheet, lefts[1], top + 24 * unit, width, full, unit)
    return sheet


def flow_range(moved: Float64Array) -> float:
    """The length in metres that gets the full colour: a round number above nearly all (N, 3) displacements."""
    lengths = np.linalg.norm(moved, axis=-1)
    # Objects may be a small part of the image: the percentile is of what moves at all.
    lengths = lengths[lengths > SMALLEST_RANGE / 4]
    largest = float(np.percentile(lengths, 98)) if len(lengths) else 0.0
    if largest <= SMALLEST_RANGE:
        return SMALLEST_RANGE
    step = 10.0 ** math.floor(math.log10(largest))
    return next(step * factor for factor in (1, 1.5, 2, 3, 4, 5, 6, 8, 10) if step * factor >= largest * 0.999)


def _panel(picture: UInt8Array, known: BoolMask, color: UInt8Array, scale: int) -> UInt8Array:
    brightness = cv2.cvtColor(color, cv2.COLOR_RGB2GRAY).astype(np.float32) / 255
    shaded = picture * (0.72 + 0.28 * brightness[..., None])
    shaded[~known] = np.array(NO_DEPTH) * 0.92
    image = np.rint(shaded).astype(np.uint8)
    size = (image.shape[1] * scale, image.shape[0] * scale)
    # Nearest: between two flows there is no third one.
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_NEAREST), dtype=np.uint8)


def _draw_wheel(sheet: UInt8Array, x: float, y: float, radius: float, full: float, unit: float) -> None:
    """The wheel of directions, and what its rim stands for."""
    half = math.ceil(radius) + 2
    cx, cy = round(x), round(y)
    down, right = np.mgrid[-half : half + 1, -half : half + 1].astype(np.float64)
    disk = colors.wheel(right / radius, down / radius)
    alpha = np.clip(radius + 0.5 - np.hypot(right, down), 0, 1)[..., None]
    patch = sheet[cy - half : cy + half + 1, cx - half : cx + half + 1]
    patch[...] = np.rint(patch + (disk.astype(np.float64) - patch) * alpha).astype(np.uint8)
    left = x + radius + 16 * unit
    canvas.write(sheet, "colour = direction in the image", left, y - 9 * unit, 15 * unit, INK)
    canvas.write(sheet, f"rim = {_centimetres(full)} or more", left, y + 17 * unit, 15 * unit, INK)


def _draw_no_depth(sheet: UInt8Array, right: float, y: float, unit: float) -> None:
    words = "no depth"
    width, height = canvas.text_size(words, 15 * unit)
    left = right - width
    side = 18 * unit
    x = left - side - 8 * unit
    shade = (round(NO_DEPTH[0] * 0.92), round(NO_DEPTH[1] * 0.92), round(NO_DEPTH[2] * 0.92))
    canvas.polygon(
        sheet, [(x, y - side / 2), (x + side, y - side / 2), (x + side, y + side / 2), (x, y + side / 2)], shade
    )
    canvas.write(sheet, words, left, y + height / 2, 15 * unit, INK)


def _draw_bar(sheet: UInt8Array, left: int, top: float, width: int, full: float, unit: float) -> None:
    """The bar from towards the camera to away from it, with ticks."""
    start, end = left + round(60 * unit), left + width - round(60 * unit)
    y0, y1 = round(top), round(top + 20 * unit)
    ramp = colors.diverging(np.linspace(-1, 1, end - start))
    sheet[y0:y1, start:end] = ramp
    cv2.rectangle(sheet, (start, y0), (end - 1, y1 - 1), (173, 181, 189), 1)
    for value in (-1.0, -0.5, 0.0, 0.5, 1.0):
        x = start + (value + 1) / 2 * (end - start - 1)
        canvas.line(sheet, [(x, y1), (x, y1 + 5 * unit)], INK, round(unit))
        sign = "-" if value < 0 else "+" if value > 0 else ""
        words = f"{sign}{_centimetres(abs(value) * full)}" if value else "0"
        canvas.write(sheet, words, x - canvas.text_size(words, 14 * unit)[0] / 2, y1 + 20 * unit, 14 * unit, INK)
    for words, x in (("towards the camera", start), ("away from it", end)):
        shift = 0.0 if x == start else canvas.text_size(words, 15 * unit)[0]
        canvas.write(sheet, words, x - shift, y1 + 44 * unit, 15 * unit, INK)


def _centimetres(metres: float) -> str:
    return f"{metres * 100:.3g} cm"
