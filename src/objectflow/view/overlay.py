"""`overlay.png`: masks, outlines, ids and motion arrows over the current frame."""

from __future__ import annotations

import math

import cv2
import numpy as np
from scipy import ndimage

from objectflow import geometry
from objectflow.frame import RgbdFrame
from objectflow.motion import ObjectMotion, SceneMotion
from objectflow.typing import BoolMask, Float32Array, UInt8Array
from objectflow.view import canvas
from objectflow.view.colors import INK, PAPER, Rgb, object_color

TARGET_WIDTH = 960
"""Minimum width, pixels; smaller images are enlarged by an integer factor so that text and outlines are crisp."""


def draw_overlay(curr: RgbdFrame, motion: SceneMotion) -> UInt8Array:
    """Draw the objects over the current frame.

    Moving objects are filled and have an arrow from their centre's previous to its current position; static objects
    are outlined.

    Args:
        curr: the current frame, (H, W).
        motion: its result, of the same size.

    Returns:
        (s H, s W, 3) uint8 RGB, with an integer factor s >= 1.
    """
    scale = math.ceil(TARGET_WIDTH / curr.camera.width)
    size = (curr.camera.width * scale, curr.camera.height * scale)
    unit = max(size) / 960
    photo = np.asarray(cv2.resize(curr.color, size, interpolation=cv2.INTER_CUBIC), dtype=np.uint8)
    grey = cv2.cvtColor(cv2.cvtColor(photo, cv2.COLOR_RGB2GRAY), cv2.COLOR_GRAY2RGB)
    # The image is desaturated and brightened so that the objects stand out.
    image = np.asarray(cv2.addWeighted(photo, 0.55, cv2.addWeighted(grey, 0.85, grey, 0, 38), 0.45, 0), dtype=np.uint8)
    ordered = sorted(motion.objects, key=lambda obj: obj.moving)
    for obj in ordered:
        image = _draw_mask(image, photo, motion.labels == obj.id, obj, scale, unit)
    tags = []
    for obj in ordered:
        if not (motion.labels == obj.id).any():
            continue
        anchor = _anchor(motion.labels == obj.id, scale)
        if obj.moving:
            anchor = _draw_arrow(image, curr, obj, scale, unit) or anchor
        tags.append((obj, anchor))
    for obj, anchor in tags:
        _draw_tag(image, obj, anchor, unit)
    return image


def _draw_mask(
    image: UInt8Array, photo: UInt8Array, mask: BoolMask, obj: ObjectMotion, scale: int, unit: float
) -> UInt8Array:
    """Outline a mask smoothly, and fill it if the object moves."""
    distance = _signed_distance(mask, scale)
    inside = np.clip(distance + 0.5, 0, 1)
    color = object_color(obj.id)
    if obj.moving:
        restored = image.astype(np.float32)
        restored += (photo - restored) * inside[..., None]
        image = canvas.blend(np.rint(restored).astype(np.uint8), color, 0.38 * inside)
    width = (1.6 if obj.moving else 1.1) * unit
    image = canvas.blend(image, PAPER, 0.85 * np.clip(width + 1.2 * unit + 0.5 - np.abs(distance), 0, 1))
    return canvas.blend(image, color, np.clip(width + 0.5 - np.abs(distance), 0, 1))


def _signed_distance(mask: BoolMask, scale: int) -> Float32Array:
    """Signed distance to the smoothed border of an enlarged mask, pixels, positive inside."""
    size = (mask.shape[1] * scale, mask.shape[0] * scale)
    soft = cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_LINEAR)
    soft = cv2.GaussianBlur(soft, (0, 0), sigmaX=0.6 * scale + 0.4, borderType=cv2.BORDER_REPLICATE)
    inside = np.asarray(soft > 0.5, dtype=np.uint8)
    into = cv2.distanceTransform(inside, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    out = cv2.distanceTransform(1 - inside, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    # Both distances are to the nearest pixel of the other side; the border lies half a pixel before it.
    return np.where(inside > 0, into - 0.5, 0.5 - out).astype(np.float32)


def _anchor(mask: BoolMask, scale: int) -> canvas.Point:
    """The mask's point furthest from its border, in coordinates of the enlarged picture."""
    distance = ndimage.distance_transform_edt(np.pad(mask, 1))[1:-1, 1:-1]
    v, u = np.unravel_index(int(np.argmax(distance)), mask.shape)
    return _enlarge(float(u), float(v), scale)


def _draw_arrow(image: UInt8Array, curr: RgbdFrame, obj: ObjectMotion, scale: int, unit: float) -> canvas.Point | None:
    """Draw the displacement of the centre in the image and return its end, or None if it is out of view."""
    ends = geometry.project(np.stack([obj.center + obj.translation, obj.center]), curr.camera)
    if not np.isfinite(ends).all() or np.abs(ends).max() > 4 * max(curr.camera.width, curr.camera.height):
        return None
    start, end = (_enlarge(float(u), float(v), scale) for u, v in ends)
    if math.dist(start, end) >= 3 * unit:
        canvas.arrow(image, start, end, PAPER, 4.5 * unit, INK)
    canvas.disk(image, start, 5.5 * unit, INK)
    canvas.disk(image, start, 4.0 * unit, PAPER)
    return end


def _draw_tag(image: UInt8Array, obj: ObjectMotion, anchor: canvas.Point, unit: float) -> None:
    """Draw a rounded tag beside the anchor: the id and, for moving objects, displacement and rotation."""
    size = 17 * unit
    number = str(obj.id)
    caption = ""
    if obj.moving:
        angle = math.degrees(float(np.linalg.norm(obj.rotation_vector)))
        caption = f"{100 * float(np.linalg.norm(obj.translation)):.1f} cm  {angle:.0f}°"
    number_width, height = canvas.text_size(number, size, bold=True)
    caption_width = canvas.text_size(caption, size)[0] + 9 * unit if caption else 0.0
    pad = 7 * unit
    box = (max(number_width, height) + 2 * pad, height + 1.7 * pad)
    total = box[0] + (caption_width + pad if caption else 0)
    left = min(max(anchor[0] + 12 * unit, 4 * unit), image.shape[1] - total - 4 * unit)
    top = min(max(anchor[1] - box[1] - 10 * unit, 4 * unit), image.shape[0] - box[1] - 4 * unit)
    color = object_color(obj.id)
    _rounded(image, left - 1.5 * unit, top - 1.5 * unit, total + 3 * unit, box[1] + 3 * unit, PAPER, 6.5 * unit)
    _rounded(image, left, top, box[0], box[1], color, 5 * unit)
    baseline = top + (box[1] + height) / 2
    canvas.write(image, number, left + (box[0] - number_width) / 2, baseline, size, PAPER, bold=True)
    if caption:
        canvas.write(image, caption, left + box[0] + 7 * unit, baseline, size, INK)


def _rounded(
    image: UInt8Array, left: float, top: float, width: float, height: float, color: Rgb, radius: float
) -> None:
    right, bottom = left + width, top + height
    x0, x1, y0, y1 = left + radius, right - radius, top + radius, bottom - radius
    canvas.polygon(image, [(x0, top), (x1, top), (x1, bottom), (x0, bottom)], color)
    canvas.polygon(image, [(left, y0), (right, y0), (right, y1), (left, y1)], color)
    for x in (x0, x1):
        for y in (y0, y1):
            canvas.disk(image, (x, y), radius, color)


def _enlarge(u: float, v: float, scale: int) -> canvas.Point:
    """Map a point to the enlarged picture; in both, pixel centres are integers and the corner is (-0.5, -0.5)."""
    return (u + 0.5) * scale - 0.5, (v + 0.5) * scale - 0.5
