"""Depth and colour errors of the current frame, warped to the previous one by the ground truth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from objectflow import geometry
from objectflow.dataset.schema import PairRow
from objectflow.geometry.resample import bilinear_corners, interpolate_corners, sample_bilinear
from objectflow.typing import BoolMask, Float64Array, LabelImage

SELF_OCCLUSION = 0.02
"""Metres: a warped point this far behind the previous surface was occluded by its own object."""

MIN_COSINE = 0.1
"""Minimum cosine between viewing ray and surface normal, in both frames: the depth of grazing surfaces is inexact."""


@dataclass(frozen=True, eq=False)
class WarpErrors:
    """Errors at the comparable pixels of the current frame; (N,) each.

    A pixel is comparable if its four neighbours have the same label, its surface faces the camera in both frames, and
    its previous position lies between four pixels of the same object and is not occluded by that object.

    Attributes:
        labels: of the pixels.
        depth: metres, warped minus measured.
        color: grey levels, mean absolute difference over the channels.
    """

    labels: LabelImage
    depth: Float64Array
    color: Float64Array


def warp_errors(row: PairRow, *, raw: bool) -> WarpErrors:
    """Warp every object that is visible in both frames back in time.

    Args:
        row: the pair.
        raw: whether to use the raw rotation instead of the symmetry-reduced one. Colour errors are meaningful only
            with the raw one, since textures may break the symmetry of a shape.
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
    facing = (_cosine(points, normals) > MIN_COSINE) & (_cosine(warped, turned) > MIN_COSINE)

    place = geometry.project(warped, row.prev.camera)
    inverse, seen_color, same = _bilinear(row, place, labels)
    difference = warped[:, 2] - 1 / np.where(inverse > 0, inverse, np.nan)
    keep = np.logical_and.reduce([facing, same, ~(difference > SELF_OCCLUSION)])
    error = np.abs(color - seen_color).mean(-1)
    return WarpErrors(labels[keep], difference[keep], error[keep])


def _bilinear(row: PairRow, place: Float64Array, labels: LabelImage) -> tuple[Float64Array, Float64Array, BoolMask]:
    """Inverse depth (exact on planes) and colour of the previous frame, and whether all four pixels have the label."""
    height, width = row.prev.depth.shape
    with np.errstate(invalid="ignore"):
        inside = np.asarray(((place >= 0) & (place < (width - 1, height - 1))).all(-1))
    place = np.where(inside[:, None], place, 0)
    index, fraction = bilinear_corners(place, (height, width))
    depth = row.prev.depth.ravel()[index].astype(np.float64)
    same = inside & ((row.prev_labels.ravel()[index] == labels) & (depth > 0)).all(0)
    inverse = interpolate_corners(1 / np.where(depth > 0, depth, np.inf), fraction)
    return inverse, sample_bilinear(row.prev.color, place), same


def _normals(points: Float64Array) -> Float64Array:
    """(H, W, 3) unit normals towards the camera by central differences; NaN at the border and next to holes."""
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
