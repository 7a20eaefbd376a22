"""Colours of a frame's points in the 3D view: by object or by scene flow, over pale grey."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from objectflow.typing import Float32Array, UInt8Array
from objectflow.view import colors
from objectflow.view.flow import flow_range
from objectflow.view.viewer_frames import NO_TRACK


def pale_gray(color: UInt8Array) -> UInt8Array:
    """(H, W, 3) RGB -> (H, W, 3) pale grey levels."""
    brightness = color.astype(np.float32) @ np.array([0.299, 0.587, 0.114], np.float32)
    return np.repeat((70 + 0.62 * brightness)[..., None], 3, axis=2).astype(np.uint8)


def color_by_object(gray: UInt8Array, ids: NDArray[np.uint16]) -> UInt8Array:
    """Colour the points of each object, shaded by the image; other points stay grey.

    Args:
        gray: (N, 3) grey levels of the points.
        ids: (N,) object ids, 0 = background.

    Returns:
        (N, 3) uint8 RGB.
    """
    painted = gray.copy()
    for object_id in np.unique(ids[(ids > 0) & (ids != NO_TRACK)]).tolist():
        mask = ids == object_id
        shade = 0.35 + 0.65 * (gray[mask, :1].astype(np.float32) / 228)
        painted[mask] = np.rint(np.array(colors.object_color(object_id), np.float32) * shade).astype(np.uint8)
    return painted


def color_by_flow(gray: UInt8Array, own_flow: Float32Array) -> UInt8Array:
    """Colour the points by motion forward in time, as in `flow.png`; static points stay grey.

    Args:
        gray: (N, 3) grey levels of the points.
        own_flow: (N, 3) metres, as of `SceneMotion.own_flow`.

    Returns:
        (N, 3) uint8 RGB; hue = direction in the image.
    """
    moved = -own_flow.astype(np.float64)
    known = np.isfinite(moved).all(axis=-1)
    painted = gray.copy()
    full = flow_range(moved[known])
    wheel = colors.wheel(moved[known, 0] / full, moved[known, 1] / full).astype(np.float32)
    strength = np.clip(np.linalg.norm(moved[known], axis=-1) / full, 0, 1)[:, None] ** 0.5
    painted[known] = np.rint(gray[known] + (wheel - gray[known]) * strength).astype(np.uint8)
    return painted
