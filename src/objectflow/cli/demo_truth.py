"""Ground truth of the packaged pair, and the errors of a result against it."""

from __future__ import annotations

import math
from pathlib import Path
from typing import NamedTuple

import numpy as np

from objectflow import geometry
from objectflow.errors import ReaderError
from objectflow.frame import RgbdFrame
from objectflow.motion import SceneMotion
from objectflow.typing import BoolMask, Float64Array, LabelImage

MIN_IOU = 0.5
"""Intersection over union above which an object counts as found."""


class DemoTruth(NamedTuple):
    """Ground truth of the pair's K objects.

    Attributes:
        names: of the objects.
        moving: (K,) whether each object moved.
        labels: (H, W) labels 1..K on the current frame's pixels.
        prev_T_curr: (K, 4, 4) motions, metres.
        centers: (K, 3) metres, camera frame, in the current frame.
    """

    names: list[str]
    moving: BoolMask
    labels: LabelImage
    prev_T_curr: Float64Array
    centers: Float64Array

    @classmethod
    def read(cls, path: Path) -> DemoTruth:
        """Read `truth.npz`.

        Raises:
            ReaderError: the file is missing or broken.
        """
        try:
            with np.load(path, allow_pickle=False) as data:
                return cls(
                    names=[str(name) for name in data["names"]],
                    moving=data["moving"],
                    labels=data["labels1"].astype(np.int32),
                    prev_T_curr=data["prev_T_curr"],
                    centers=data["centers"],
                )
        except (OSError, ValueError, KeyError) as error:
            raise ReaderError(f"{path}: cannot be read: {error}: install objectflow again") from error


class DemoMatch(NamedTuple):
    """The match of one true object and its errors; id 0 and NaN errors if it was not found."""

    id: int
    iou: float
    translation_mm: float
    rotation_deg: float


def match_object(mask: BoolMask, center: Float64Array, prev_T_curr: Float64Array, motion: SceneMotion) -> DemoMatch:
    """Match a true object to the object of a result with the largest IoU.

    Args:
        mask: (H, W) the true mask.
        center: (3,) the true centre, metres, camera frame; the translation error is measured there.
        prev_T_curr: (4, 4) the true motion.
        motion: the result.
    """
    best = DemoMatch(0, 0.0, math.nan, math.nan)
    for obj in motion.objects:
        predicted = motion.labels == obj.id
        iou = float((predicted & mask).sum() / max(1, (predicted | mask).sum()))
        if iou <= max(best.iou, MIN_IOU):
            continue
        offset = geometry.transform(obj.prev_T_curr, center) - geometry.transform(prev_T_curr, center)
        angle = geometry.rotation_angle(obj.prev_T_curr[:3, :3].T @ prev_T_curr[:3, :3])
        best = DemoMatch(obj.id, iou, 1000 * float(np.linalg.norm(offset)), math.degrees(float(angle)))
    return best


def flow_errors(truth: DemoTruth, curr: RgbdFrame, motion: SceneMotion) -> tuple[float, float]:
    """Mean end-point error of the scene flow in metres: on moving objects, and elsewhere."""
    motions = {index + 1: truth.prev_T_curr[index] for index in range(len(truth.names))}
    points = geometry.back_project(curr.depth, curr.camera)
    error = np.linalg.norm(motion.scene_flow - geometry.flow_from_motions(points, truth.labels, motions), axis=-1)
    moved = np.isin(truth.labels, np.flatnonzero(truth.moving) + 1)
    known = np.isfinite(error)
    return float(error[known & moved].mean()), float(error[known & ~moved].mean())
