"""Background that moving objects uncovered: it was hidden, stands still, and is no evidence of another motion."""

from __future__ import annotations

import cv2
import numpy as np

from objectflow import geometry
from objectflow.methods.labels import Objects
from objectflow.methods.postprocess.pair_likelihood import PairLikelihood
from objectflow.methods.postprocess.settings import StaticTestSettings
from objectflow.typing import BoolMask, Float32Array, Float64Array, LabelImage


class RestingCosts:
    """Costs of standing still of one object at a time, given where the others were.

    A pixel that standing still would have hidden is evidence of motion, unless a known mover was there and uncovered
    it. It then costs as much as its texture warrants: a surface without texture fits many motions, a textured one few.
    """

    def __init__(
        self, likelihood: PairLikelihood, labels: LabelImage, objects: Objects, settings: StaticTestSettings
    ) -> None:
        self._likelihood, self._labels, self._settings = likelihood, labels, settings
        self._static, self._hidden = likelihood.static_cost()
        contrast = cv2.blur(likelihood.pair.curr.appearance.contrast[0], (5, 5))
        self._texture = np.minimum(contrast / settings.full_texture, 1)
        self._sizes = np.bincount(labels.ravel(), minlength=1 + max((obj.id for obj in objects), default=0))
        self._footprints = {
            obj.id: self._footprint(obj.prev_T_curr, likelihood.mask(labels, obj.id)) for obj in objects if obj.moving
        }

    def of(self, number: int) -> Float32Array:
        """(N,) cost of the pixels of an object that have depth, row by row."""
        mask = self._likelihood.mask(self._labels, number)
        static = self._static[mask]
        occupied = np.zeros(len(static), bool)
        for other, footprint in self._footprints.items():
            # A small piece that moves with its neighbour is more probably background than the neighbour is.
            if other != number and self._sizes[other] > len(static):
                occupied |= footprint[mask]
        uncovered = self._hidden[mask] & occupied
        low = self._settings.uncovered_cost
        reduced = low + np.maximum(static - low, 0) * self._texture[mask]
        return np.where(uncovered, np.minimum(reduced, static), static).astype(np.float32)

    def _footprint(self, prev_T_curr: Float64Array, mask: BoolMask) -> BoolMask:
        """(H, W) bool: where an object was in the previous frame."""
        camera = self._likelihood.pair.prev.frame.camera
        pixels = geometry.project(geometry.transform(prev_T_curr, self._likelihood.points[mask]), camera)
        column, row = np.rint(np.nan_to_num(pixels.reshape(-1, 2), nan=-9)).clip(-9, 1e6).astype(np.intp).T
        inside = (column >= 0) & (row >= 0) & (column < camera.width) & (row < camera.height)
        occupied = np.zeros(mask.shape, np.uint8)
        occupied[row[inside], column[inside]] = 1
        return np.asarray(cv2.dilate(occupied, np.ones((7, 7), np.uint8)) > 0)
