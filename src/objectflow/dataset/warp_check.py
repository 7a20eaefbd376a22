"""Warp a pair by its own truth: how far depth and colour of the current frame are from the previous frame's."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from objectflow import geometry
from objectflow.dataset.schema import PairRow
from objectflow.typing import BoolMask, Float64Array, LabelImage

HIDDEN = 0.02
"""Metres: a warped point this far behind what the previous frame shows there was hidden by its own object."""

FACING = 0.1
"""Least cosine between ray and surface, in both frames: a surface seen edge-on has no exact depth."""


@dataclass(frozen=True, eq=False)
class WarpErrors:
    """Errors at the pixels of the current frame that can be compared; (N,) each.

    A pixel counts if its four neighbours carry its label, its surface faces the camera in both frames, and the place
    it came from lies between four pixels of its object in the previous frame and is not hidden by that object itself.

    Attributes:
        labels: whose pixel it is.
        depth: metres, warped minus measured.
        color: grey levels, mean absolute difference of the channels.
    """

    labels: LabelImage
    depth: Float64Array
    color: Float64Array


def warp_errors(row: PairRow, *, raw: bool) -> WarpErrors:
    """Warp every object of both frames back in time, with its raw or its symmetry-reduced rotation.

    Only the raw rotation takes colours with it: a texture may well break the symmetry of the shape.
    """
    motions = np.full((int(max(row.curr_labels.max(), row.prev_labels.max())) + 1, 4, 4), np.nan)
    for obj in row.objects:
        if obj.in_both:
            motions[obj.label] = obj.prev_T_curr(raw=raw)
    points = geometry.back_project(row.curr.depth, row.curr.camera).astype(np.float64)
    normals = _normals(points)
    known = np.isfinite(normals).all(-1) & np.isfinite(motions[row.curr_labels, 0, 0])
    inner = np.asarray(_same_neighbours(row.curr_labels) & known)

    labels, points, normals = row.curr_labels[inner], points[inner], normals[inner]
    color = row.curr.color[inner].astype(np.float64)
    R, t = motions[labels, :3, :3], motions[labels, :3, 3]
    warped = np.einsum("nij,nj->ni", R, points) + t
    turned = np.einsum("nij,nj->ni", R, normals)
    facing = (_cosine(points, normals) > FACING) & (_cosine(warped, turned) > FACING)

    place = geometry.project(warped, row.prev.camera)
    inverse, seen_color, same = _bilinear(row, place, labels)
    difference = warped[:, 2] - 1 / np.where(inverse > 0, inverse, np.nan)
    keep = np.logical_and.reduce([facing, same, ~(difference > HIDDEN)])
    error = np.abs(color - seen_color).mean(-1)
    return WarpErrors(labels[keep], difference[keep], error[keep])


def _bilinear(row: PairRow, place: Float64Array, labels: LabelImage) -> tuple[Float64Array, Float64Array, BoolMask]:
    """Inverse depth (exact on planes) and colour of the previous frame, and where all four pixels are the object's."""
    height, width = row.prev.depth.shape
    finite = np.asarray(np.isfinite(place).all(-1))
    corner = np.floor(np.where(finite[:, None], place, 0)).astype(np.int64)
    u0, v0 = corner[:, 0], corner[:, 1]
    inside = np.logical_and.reduce([finite, u0 >= 0, v0 >= 0, u0 < width - 1, v0 < height - 1])
    corner[~inside] = 0
    fraction = np.where(inside[:, None], place - corner, 0)
    inverse, color, same = np.zeros(len(place)), np.zeros((len(place), 3)), inside
    for dv in (0, 1):
        for du in (0, 1):
            u, v = corner[:, 0] + du, corner[:, 1] + dv
            weight = np.abs(1 - du - fraction[:, 0]) * np.abs(1 - dv - fraction[:, 1])
            depth = row.prev.depth[v, u].astype(np.float64)
            same = same & (row.prev_labels[v, u] == labels) & (depth > 0)
            inverse += weight / np.where(depth > 0, depth, np.inf)
            color += weight[:, None] * row.prev.color[v, u]
    return inverse, color, same


def _normals(points: Float64Array) -> Float64Array:
    """(H, W, 3) unit normals towards the camera by central differences; NaN at the border and beside holes."""
    normals = np.full_like(points, np.nan)
    across = points[1:-1, 2:] - points[1:-1, :-2]
    down = points[2:, 1:-1] - points[:-2, 1:-1]
    inner = np.cross(down, across)
    with np.errstate(invalid="ignore", divide="ignore"):
        normals[1:-1, 1:-1] = inner / np.linalg.norm(inner, axis=-1, keepdims=True)
    return normals


def _cosine(points: Float64Array, normals: Float64Array) -> Float64Array:
    return np.asarray(-(points * normals).sum(-1) / np.linalg.norm(points, axis=-1))


def _same_neighbours(labels: LabelImage) -> BoolMask:
    same = np.zeros(labels.shape, dtype=bool)
    middle = labels[1:-1, 1:-1]
    same[1:-1, 1:-1] = (
        (middle > 0)
        & (middle == labels[1:-1, 2:])
        & (middle == labels[1:-1, :-2])
        & (middle == labels[2:, 1:-1])
        & (middle == labels[:-2, 1:-1])
    )
    return same
