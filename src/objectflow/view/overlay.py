"""`overlay.png`: masks, outlines, ids and motion arrows over the current frame."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import cv2
import numpy as np
from scipy import ndimage

from objectflow import geometry
from objectflow.frame import RgbdFrame
from objectflow.geometry.camera import Camera
from objectflow.geometry.resample import resize_color, resize_nearest
from objectflow.motion import ObjectMotion, SceneMotion
from objectflow.typing import BoolMask, Float32Array, Float64Array, LabelImage, UInt8Array
from objectflow.view import canvas
from objectflow.view.colors import INK, PAPER, object_color
from objectflow.view.tags import Tag, draw_legend, draw_numbers, draw_tags

TARGET_WIDTH = 960
"""Minimum width, pixels; smaller images are enlarged by an integer factor so that text and outlines are crisp."""
MAX_LENGTH = 1920
"""Maximum length of the longer side, pixels; larger images are reduced."""
NO_TRACK = (173, 181, 189)
"""Colour of objects without a track, RGB."""
ARROW_ROOM = 24
"""Width around an arrow that captions avoid, in 1/960 of the picture's longer side."""
MAX_TAGS = 10
"""Number of moving objects above which captions move from the image to a legend below it."""


class TrackMarks(NamedTuple):
    """Numbers, colours and trails that last over a sequence.

    Attributes:
        ids: track id by the object's id in the result; other objects are drawn in grey and without a number.
        trails: track id -> (N, 3) metres, the earlier positions of the object, current camera frame, oldest first.
    """

    ids: Mapping[int, int]
    trails: Mapping[int, Float64Array]


def draw_overlay(curr: RgbdFrame, motion: SceneMotion, tracks: TrackMarks | None = None) -> UInt8Array:
    """Draw the objects over the current frame.

    Moving objects are filled and have an arrow from their centre's previous to its current position in the world,
    both as seen by the current camera; static objects are outlined.

    Args:
        curr: the current frame, (H, W).
        motion: its result, of the same size.
        tracks: numbers, colours and trails of the objects; those of the result, and no trails, if None.

    Returns:
        (H', W', 3) uint8 RGB. W' is a whole multiple of W for images up to `MAX_LENGTH`. More than `MAX_TAGS` moving
        objects are listed in a legend below the image.
    """
    numbers = {obj.id: obj.id for obj in motion.objects} if tracks is None else tracks.ids
    color, labels, camera = _reduced(curr, motion.labels)
    scale = math.ceil(TARGET_WIDTH / camera.width)
    size = (camera.width * scale, camera.height * scale)
    unit = max(size) / 960
    photo = np.asarray(cv2.resize(color, size, interpolation=cv2.INTER_CUBIC), dtype=np.uint8) if scale > 1 else color
    grey = cv2.cvtColor(cv2.cvtColor(photo, cv2.COLOR_RGB2GRAY), cv2.COLOR_GRAY2RGB)
    # The image is desaturated and brightened so that the objects stand out.
    image = np.asarray(cv2.addWeighted(photo, 0.2, grey, 0.5, 70), dtype=np.uint8)
    boxes = ndimage.find_objects(labels)
    visible = [obj for obj in motion.objects if obj.id <= len(boxes) and boxes[obj.id - 1] is not None]
    ordered = sorted(visible, key=lambda obj: obj.moving)
    anchors = {}
    for obj in ordered:
        shade = object_color(numbers[obj.id]) if obj.id in numbers else NO_TRACK
        anchors[obj.id] = _draw_mask(image, photo, labels, obj, boxes[obj.id - 1], shade, scale, unit)
    for number, trail in (tracks.trails if tracks else {}).items():
        _draw_trail(image, camera, trail, object_color(number), scale, unit)
    tags = []
    # Tags avoid masks and arrows.
    busy = (labels > 0).astype(np.uint8)
    for obj in ordered:
        anchor = anchors[obj.id]
        if obj.moving and (ends := _arrow_ends(camera, obj, scale)) is not None:
            _draw_arrow(image, *ends, obj.motion_known, unit)
            start, end = ((round(u / scale), round(v / scale)) for u, v in ends)
            cv2.line(busy, start, end, 1, max(1, round(ARROW_ROOM * unit / scale)))
            anchor = ends[1]
        if obj.id in numbers:
            tags.append(Tag.of(obj, numbers[obj.id], anchor, boxes[obj.id - 1], scale))
    if sum(tag.caption != "" for tag in tags) > MAX_TAGS:
        draw_numbers(image, tags, unit)
        return draw_legend(image, tags, unit)
    draw_tags(image, tags, np.asarray(busy > 0, dtype=np.bool_), scale, unit)
    return image


def _reduced(curr: RgbdFrame, labels: LabelImage) -> tuple[UInt8Array, LabelImage, Camera]:
    """Colour, labels and camera at no more than `MAX_LENGTH`."""
    camera = curr.camera
    factor = MAX_LENGTH / max(camera.width, camera.height)
    if factor >= 1:
        return curr.color, labels, camera
    camera = camera.scaled(max(1, round(factor * camera.width)), max(1, round(factor * camera.height)))
    size = (camera.height, camera.width)
    return resize_color(curr.color, size), np.asarray(resize_nearest(labels, size), dtype=np.int32), camera


def _draw_mask(
    image: UInt8Array,
    photo: UInt8Array,
    labels: LabelImage,
    obj: ObjectMotion,
    box: tuple[slice, ...],
    color: tuple[int, int, int],
    scale: int,
    unit: float,
) -> canvas.Point:
    """Outline a mask smoothly, fill it if the object moves, and return its point furthest from its border.

    Only the mask's surroundings are computed, since large images hold small objects.
    """
    width = (1.6 if obj.moving else 1.1) * unit
    margin = math.ceil((width + 1.2 * unit + 1) / scale) + 4
    rows, columns = (
        slice(max(0, side.start - margin), min(length, side.stop + margin))
        for side, length in zip(box, labels.shape, strict=True)
    )
    mask = labels[rows, columns] == obj.id
    distance = _signed_distance(mask, scale)
    window = (
        slice(rows.start * scale, rows.stop * scale),
        slice(columns.start * scale, columns.stop * scale),
    )
    part, inside = image[window], np.clip(distance + 0.5, 0, 1)
    if obj.moving:
        restored = part.astype(np.float32)
        restored += (photo[window] - restored) * inside[..., None]
        part = canvas.blend(np.rint(restored).astype(np.uint8), color, 0.5 * inside)
    part = canvas.blend(part, PAPER, 0.85 * np.clip(width + 1.2 * unit + 0.5 - np.abs(distance), 0, 1))
    image[window] = canvas.blend(part, color, np.clip(width + 0.5 - np.abs(distance), 0, 1))
    row, column = np.unravel_index(int(np.argmax(distance)), distance.shape)
    return float(column + window[1].start), float(row + window[0].start)


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


def _arrow_ends(camera: Camera, obj: ObjectMotion, scale: int) -> tuple[canvas.Point, canvas.Point] | None:
    """The centre's previous and current position in the picture, or None if it is out of view."""
    ends = geometry.project(np.stack([obj.prev_center, obj.center]), camera)
    if not np.isfinite(ends).all() or np.abs(ends).max() > 4 * max(camera.width, camera.height):
        return None
    start, end = (_enlarge(float(u), float(v), scale) for u, v in ends)
    return start, end


def _draw_arrow(image: UInt8Array, start: canvas.Point, end: canvas.Point, known: bool, unit: float) -> None:
    """Draw the displacement of a centre; `known` tells whether the motion is known at all."""
    if math.dist(start, end) >= 3 * unit:
        canvas.arrow(image, start, end, PAPER, 5.5 * unit, INK)
    elif known:
        # A motion along the ray has no direction in the image.
        canvas.disk(image, end, 4.5 * unit, INK)
        canvas.disk(image, end, 3.0 * unit, PAPER)


def _draw_trail(
    image: UInt8Array, camera: Camera, trail: Float64Array, color: tuple[int, int, int], scale: int, unit: float
) -> None:
    """Draw the earlier positions of an object's centre as a line."""
    pixels = geometry.project(trail, camera)
    limit = 4 * max(camera.width, camera.height)
    points = [_enlarge(float(u), float(v), scale) for u, v in pixels if max(abs(u), abs(v)) < limit]
    if len(points) > 1:
        canvas.line(image, points, PAPER, round(5 * unit))
        canvas.line(image, points, color, round(3 * unit))


def _enlarge(u: float, v: float, scale: int) -> canvas.Point:
    """Map a point to the enlarged picture; in both, pixel centres are integers and the corner is (-0.5, -0.5)."""
    return (u + 0.5) * scale - 0.5, (v + 0.5) * scale - 0.5
