"""Pictures of a data set's rows: colour with the centres of objects, depth, labels, and the flow as in `flow.png`."""

from __future__ import annotations

import colorsys
from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from objectflow import geometry
from objectflow.dataset.moving_objects import keep_labels
from objectflow.dataset.row_motion import motion_of_row
from objectflow.dataset.schema import PairRow, SequenceRow
from objectflow.frame import RgbdFrame
from objectflow.geometry.camera import Camera
from objectflow.typing import Float32Array, LabelImage, UInt8Array
from objectflow.view.flow import draw_flow

TITLE = 18
"""Pixels: height of the title above each panel."""

PANEL_WIDTH = 320
"""Pixels: smaller images are enlarged to this width, so that text and centres are legible."""


def draw_pair(row: PairRow) -> UInt8Array:
    """Draw a pair (h, w, 3) uint8 RGB: colour, depth and labels of both frames, and the flow as in `flow.png`.

    Crosses are the centres of objects visible in both frames; lines on the current frame lead to the previous centres.
    """
    near, far = _range([row.prev, row.curr])
    both = [obj for obj in row.objects if obj.in_both]
    centers = np.array([obj.center for obj in both]).reshape(-1, 3)
    before = centers + np.array([obj.translation for obj in both]).reshape(-1, 3)
    motion = motion_of_row(row)
    moving = keep_labels(row.curr_labels, {obj.id for obj in motion.moving})
    panels = [
        [
            ("previous", _with_centers(row.prev, before, None)),
            ("current, centres and where they were", _with_centers(row.curr, centers, before)),
            (f"{row.key}: {len(row.objects)} objects, {len(motion.moving)} moved", _draw_labels(moving, None)),
        ],
        [
            (f"previous depth, {near:.2f}-{far:.2f} m", _draw_depth(row.prev.depth, near, far)),
            (f"current depth, {near:.2f}-{far:.2f} m", _draw_depth(row.curr.depth, near, far)),
            ("current labels", _draw_labels(row.curr_labels, row.curr.color)),
        ],
    ]
    grid = _sheet(panels)
    flow = draw_flow(row.curr, motion)
    height = round(flow.shape[0] * grid.shape[1] / flow.shape[1])
    flow = np.asarray(cv2.resize(flow, (grid.shape[1], height), interpolation=cv2.INTER_AREA), dtype=np.uint8)
    return np.concatenate([grid, flow])


def draw_rows(rows: Sequence[PairRow]) -> UInt8Array:
    """Draw several pairs, one per line (h, w, 3) uint8 RGB: both frames with centres, and the current labels."""
    lines = []
    for row in rows:
        both = [obj for obj in row.objects if obj.in_both]
        centers = np.array([obj.center for obj in both]).reshape(-1, 3)
        before = centers + np.array([obj.translation for obj in both]).reshape(-1, 3)
        moved = len(motion_of_row(row).moving)
        lines.append(
            [
                (f"{row.key}, previous", _with_centers(row.prev, before, None)),
                ("current, centres and where they were", _with_centers(row.curr, centers, before)),
                (f"labels, {len(row.objects)} objects, {moved} moved", _draw_labels(row.curr_labels, row.curr.color)),
            ]
        )
    return _sheet(lines)


def draw_frames(rows: Sequence[SequenceRow]) -> UInt8Array:
    """Draw frames of a sequence, one per line (h, w, 3) uint8 RGB: colour with centres, depth, labels."""
    near, far = _range([row.image for row in rows])
    panels = []
    for row in rows:
        seen = set(np.unique(row.labels).tolist())
        centers = np.array([obj.pose[:3, 3] for obj in row.objects if obj.label in seen]).reshape(-1, 3)
        panels.append(
            [
                (f"{row.sequence}, frame {row.frame}", _with_centers(row.image, centers, None)),
                (f"depth, {near:.2f}-{far:.2f} m", _draw_depth(row.image.depth, near, far)),
                (f"labels, {len(seen - {0})} objects", _draw_labels(row.labels, row.image.color)),
            ]
        )
    return _sheet(panels)


def label_color(label: int) -> tuple[int, int, int]:
    """The RGB colour of a label. Hues advance by the golden angle, so that adjacent labels differ strongly."""
    red, green, blue = colorsys.hsv_to_rgb(label * 0.381966 % 1, 0.9 if label % 2 else 0.6, 1.0)
    return int(255 * red), int(255 * green), int(255 * blue)


def _with_centers(frame: RgbdFrame, centers: NDArray[Any], tails: NDArray[Any] | None) -> UInt8Array:
    picture = _enlarge(frame.color)
    scale = picture.shape[1] / frame.camera.width

    def place(point: NDArray[Any], camera: Camera) -> tuple[int, int] | None:
        pixel = (geometry.project(point, camera) + 0.5) * scale - 0.5
        return (round(float(pixel[0])), round(float(pixel[1]))) if np.abs(pixel).max() < 1e4 else None

    for i, center in enumerate(centers):
        head = place(center, frame.camera)
        tail = None if tails is None else place(tails[i], frame.camera)
        if head is None:
            continue
        for color, width in (((0, 0, 0), 3), ((255, 255, 0), 1)):
            if tail is not None:
                cv2.line(picture, head, tail, color, width, cv2.LINE_AA)
            cv2.drawMarker(picture, head, color, cv2.MARKER_CROSS, 9, width, cv2.LINE_AA)
    return picture


def _draw_depth(depth: Float32Array, near: float, far: float) -> UInt8Array:
    """Near pixels are bright, missing depth is black."""
    level = np.clip((far - depth) / max(far - near, 1e-6), 0, 1)
    picture = cv2.applyColorMap((255 * level).astype(np.uint8), cv2.COLORMAP_VIRIDIS)[..., ::-1].copy()
    picture[depth == 0] = 0
    return _enlarge(picture, smooth=False)


def _draw_labels(labels: LabelImage, color: UInt8Array | None) -> UInt8Array:
    table = np.array([label_color(label) if label else (40, 40, 40) for label in range(int(labels.max()) + 1)])
    picture = table[labels].astype(np.float64)
    if color is not None:
        picture = np.where(labels[..., None] > 0, 0.55 * picture + 0.45 * color, 0.6 * color)
    return _enlarge(picture.astype(np.uint8), smooth=False)


def _range(frames: Sequence[RgbdFrame]) -> tuple[float, float]:
    """Depth range of a picture in metres: the central 98 %."""
    depth = np.concatenate([frame.depth[frame.valid] for frame in frames])
    near, far = np.percentile(depth, [1, 99])
    return float(near), float(far)


def _enlarge(picture: NDArray[Any], *, smooth: bool = True) -> UInt8Array:
    factor = max(1, round(PANEL_WIDTH / picture.shape[1]))
    size = (picture.shape[1] * factor, picture.shape[0] * factor)
    mode = cv2.INTER_LINEAR if smooth else cv2.INTER_NEAREST
    return np.ascontiguousarray(cv2.resize(picture, size, interpolation=mode), dtype=np.uint8)


def _sheet(panels: Sequence[Sequence[tuple[str, UInt8Array]]]) -> UInt8Array:
    rows = []
    for line in panels:
        titled = []
        for title, picture in line:
            bar = np.full((TITLE, picture.shape[1], 3), 255, np.uint8)
            cv2.putText(bar, title, (4, 13), cv2.FONT_HERSHEY_SIMPLEX, 0.4, (0, 0, 0), 1, cv2.LINE_AA)
            titled.append(np.pad(np.concatenate([bar, picture]), ((0, 4), (0, 4), (0, 0)), constant_values=255))
        rows.append(np.concatenate(titled, axis=1))
    return np.concatenate(rows)
