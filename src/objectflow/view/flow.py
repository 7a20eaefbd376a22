"""`flow.png`: the scene flow in false colours, with a legend."""

from __future__ import annotations

import math
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from objectflow import geometry
from objectflow.frame import RgbdFrame
from objectflow.geometry.resample import nearest_indices, resize_color
from objectflow.motion import SceneMotion
from objectflow.motion.own_flow import own_flow
from objectflow.typing import BoolMask, Float32Array, LabelImage, UInt8Array
from objectflow.view import canvas, colors
from objectflow.view.colors import INK, NO_DEPTH

TARGET_WIDTH = 640
"""Minimum width of each panel, pixels; smaller images are enlarged by an integer factor."""

MAX_LENGTH = 960
"""Maximum length of a panel's longer side, pixels; larger images are reduced."""

SMALLEST_RANGE = 0.01
"""Minimum displacement at full colour, metres, so that noise stays pale."""


def draw_flow(curr: RgbdFrame, motion: SceneMotion) -> UInt8Array:
    """Draw the motion of every point in the world from the previous to the current frame.

    The panels show motion forward in time (the negative of `SceneMotion.own_flow`) on the current frame's pixels: the
    first the motion across the image (hue = direction, saturation = length), the second the motion in depth. If the
    camera moved, a third panel shows the apparent motion of a static scene. Pixels without depth are grey; the image
    is faintly visible for orientation.

    Returns:
        (H', W', 3) uint8 RGB.
    """
    color, labels, flow, points = _sampled(curr, motion)
    moved = -own_flow(flow, points, labels, motion.objects, motion.camera_motion)
    finite = np.isfinite(moved)
    known = finite[..., 0] & finite[..., 1] & finite[..., 2]
    moved = np.where(known[..., None], moved, 0)
    full = flow_range(moved[known])
    panels = [
        (
            "Motion across the image, previous to current frame",
            colors.wheel(moved[..., 0] / full, moved[..., 1] / full),
        ),
        ("Motion in depth", colors.diverging(moved[..., 2] / full)),
    ]
    camera_full = 0.0
    if motion.camera_motion is not None:
        apparent = np.nan_to_num(points - geometry.transform(motion.camera_motion, points)).astype(np.float32)
        camera_full = flow_range(apparent[known])
        picture = colors.wheel(apparent[..., 0] / camera_full, apparent[..., 1] / camera_full)
        panels.append((f"Motion of the camera, taken out: {_camera_numbers(motion)}", picture))
    scale = math.ceil(TARGET_WIDTH / labels.shape[1])
    pictures = [_panel(picture, known, color, scale) for _, picture in panels]
    height, width = pictures[0].shape[:2]
    unit = width / 640
    margin, title, legend = (round(x * unit) for x in (14, 34, 104))
    sheet = np.full((title + height + legend, len(panels) * (width + margin) + margin, 3), 255, np.uint8)
    lefts = [margin + k * (width + margin) for k in range(len(panels))]
    for left, (text, _), picture in zip(lefts, panels, pictures, strict=True):
        sheet[title : title + height, left : left + width] = picture
        cv2.rectangle(sheet, (left, title), (left + width - 1, title + height - 1), (173, 181, 189), 1)
        canvas.write(sheet, text, left, title - 11 * unit, 18 * unit, INK, bold=True)
    top = title + height
    _draw_wheel(sheet, lefts[0] + 52 * unit, top + legend / 2, 38 * unit, full, unit)
    _draw_no_depth(sheet, lefts[0] + width, top + legend / 2, unit)
    _draw_bar(sheet, lefts[1], top + 24 * unit, width, full, unit)
    if camera_full:
        _draw_wheel(sheet, lefts[2] + 52 * unit, top + legend / 2, 38 * unit, camera_full, unit)
    return sheet


def _camera_numbers(motion: SceneMotion) -> str:
    return f"{100 * motion.camera_displacement:.1f} cm, {motion.camera_rotation_deg:.1f}°"


def _sampled(curr: RgbdFrame, motion: SceneMotion) -> tuple[UInt8Array, LabelImage, Float32Array, Float32Array]:
    """Colour, labels, scene flow and points (H, W, 3) at no more than `MAX_LENGTH`; flow is never averaged."""
    camera, factor = curr.camera, MAX_LENGTH / max(curr.camera.width, curr.camera.height)
    if factor >= 1:
        return curr.color, motion.labels, motion.scene_flow, geometry.back_project(curr.depth, camera)
    size = (max(1, round(factor * camera.height)), max(1, round(factor * camera.width)))
    rows, columns = nearest_indices(curr.depth.shape, size)
    grid = (rows[:, None], columns)
    pixels = np.stack(np.broadcast_arrays(columns, rows[:, None]), axis=-1).astype(np.float32)
    depth = curr.depth[grid]
    points = geometry.back_project_pixels(pixels, np.where(depth > 0, depth, np.float32(np.nan)), camera)
    return resize_color(curr.color, size), motion.labels[grid], motion.scene_flow[grid], points.astype(np.float32)


def flow_range(moved: NDArray[np.floating[Any]]) -> float:
    """The length in metres at full colour: a round number above the 98th percentile of (N, 3) displacements."""
    x, y, z = (moved[..., k] for k in range(3))
    lengths = np.sqrt(x * x + y * y + z * z)
    # Static points are excluded, since objects may cover only a small part of the image.
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
    # Nearest neighbour, because interpolated flow across an edge would be meaningless.
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_NEAREST), dtype=np.uint8)


def _draw_wheel(sheet: UInt8Array, x: float, y: float, radius: float, full: float, unit: float) -> None:
    """Draw the colour wheel of directions and the length at its rim."""
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
    text = "no depth"
    width, height = canvas.text_size(text, 15 * unit)
    left = right - width
    side = 18 * unit
    x = left - side - 8 * unit
    shade = (round(NO_DEPTH[0] * 0.92), round(NO_DEPTH[1] * 0.92), round(NO_DEPTH[2] * 0.92))
    canvas.polygon(
        sheet, [(x, y - side / 2), (x + side, y - side / 2), (x + side, y + side / 2), (x, y + side / 2)], shade
    )
    canvas.write(sheet, text, left, y + height / 2, 15 * unit, INK)


def _draw_bar(sheet: UInt8Array, left: int, top: float, width: int, full: float, unit: float) -> None:
    """Draw the colour bar of depth motion, with ticks."""
    start, end = left + round(60 * unit), left + width - round(60 * unit)
    y0, y1 = round(top), round(top + 20 * unit)
    ramp = colors.diverging(np.linspace(-1, 1, end - start))
    sheet[y0:y1, start:end] = ramp
    cv2.rectangle(sheet, (start, y0), (end - 1, y1 - 1), (173, 181, 189), 1)
    for value in (-1.0, -0.5, 0.0, 0.5, 1.0):
        x = start + (value + 1) / 2 * (end - start - 1)
        canvas.line(sheet, [(x, y1), (x, y1 + 5 * unit)], INK, round(unit))
        sign = "-" if value < 0 else "+" if value > 0 else ""
        text = f"{sign}{_centimetres(abs(value) * full)}" if value else "0"
        canvas.write(sheet, text, x - canvas.text_size(text, 14 * unit)[0] / 2, y1 + 20 * unit, 14 * unit, INK)
    for text, x in (("towards the camera", start), ("away from it", end)):
        shift = 0.0 if x == start else canvas.text_size(text, 15 * unit)[0]
        canvas.write(sheet, text, x - shift, y1 + 44 * unit, 15 * unit, INK)


def _centimetres(metres: float) -> str:
    return f"{metres * 100:.3g} cm"
