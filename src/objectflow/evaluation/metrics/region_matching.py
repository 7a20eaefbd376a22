"""Comparison of two label images: the overlaps of their regions, and the one-to-one matching of regions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from objectflow.errors import ResultError
from objectflow.typing import Float64Array, Int64Array, LabelImage


@dataclass(frozen=True, eq=False)
class Regions:
    """The regions of two label images of one size, including the background (label 0) if it has a pixel.

    Attributes:
        true_ids, predicted_ids: (N,) and (M,) labels, in order of their first pixel, so that results do not depend on
            the numbering of regions, even if two assignments are equally good.
        true_sizes, predicted_sizes: (N,) and (M,) numbers of pixels.
        overlap: (N, M) numbers of common pixels.
    """

    true_ids: Int64Array
    predicted_ids: Int64Array
    true_sizes: Int64Array
    predicted_sizes: Int64Array
    overlap: Int64Array

    @property
    def f(self) -> Float64Array:
        """(N, M) F-measures of all pairs of regions; 2PR / (P + R) equals 2 |r n c| / (|r| + |c|)."""
        return np.asarray(2 * self.overlap / (self.true_sizes[:, None] + self.predicted_sizes))

    def without_background(self) -> Regions:
        """The regions of objects only; sizes remain those of whole regions."""
        t, p = self.true_ids != 0, self.predicted_ids != 0
        return Regions(
            self.true_ids[t],
            self.predicted_ids[p],
            self.true_sizes[t],
            self.predicted_sizes[p],
            self.overlap[t][:, p],
        )


def compare(true: LabelImage, predicted: LabelImage) -> Regions:
    """Count the common pixels of the regions of two label images.

    Args:
        true, predicted: (H, W) integers, 0 = background.

    Raises:
        ResultError: images of different sizes, or labels that are negative or not integers.
    """
    if true.shape != predicted.shape or true.ndim != 2 or true.size == 0:
        raise ResultError(f"predicted labels {predicted.shape} do not fit true labels {true.shape}")
    true_ids, t = _number_regions(true, "true")
    predicted_ids, p = _number_regions(predicted, "predicted")
    n, m = len(true_ids), len(predicted_ids)
    overlap = np.bincount(t * m + p, minlength=n * m).reshape(n, m).astype(np.int64)
    return Regions(true_ids, predicted_ids, overlap.sum(1), overlap.sum(0), overlap)


def assign_regions(regions: Regions) -> list[tuple[int, int]]:
    """The one-to-one pairs (true index, predicted index) with the largest sum of F-measures (Hungarian method).

    Two regions without a common pixel are not paired: the true one is unmatched, the predicted one surplus.
    """
    rows, columns = linear_sum_assignment(regions.f, maximize=True)
    return [(int(i), int(j)) for i, j in zip(rows, columns, strict=True) if regions.overlap[i, j] > 0]


def _number_regions(labels: LabelImage, name: str) -> tuple[Int64Array, Int64Array]:
    """The labels in order of their first pixel, and the flat index into them of every pixel."""
    if labels.dtype.kind not in "iu":
        raise ResultError(f"{name} labels must be integers, not {labels.dtype}")
    flat = labels.ravel()
    if flat.min() < 0:
        raise ResultError(f"{name} labels must be 0 (background) or above, not {int(flat.min())}")
    if flat.max() <= flat.size:  # a lookup table is faster than a sort
        ids = np.flatnonzero(np.bincount(flat))
        index = np.zeros(int(ids[-1]) + 1, np.int64)
        index[ids] = np.arange(len(ids))
        inverse = index[flat]
    else:
        ids, inverse = np.unique(flat, return_inverse=True)
        inverse = inverse.reshape(-1)  # NumPy 2.0 returns it in the input's shape
    first = np.zeros(len(ids), np.int64)
    first[inverse[::-1]] = np.arange(flat.size)[::-1]  # the last write to an index wins, which is the first pixel
    order = np.argsort(first)
    rank = np.empty(len(ids), np.int64)
    rank[order] = np.arange(len(ids))
    return ids[order].astype(np.int64), rank[inverse]
