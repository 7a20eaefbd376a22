"""Precision, recall, F-measure and extracted objects of one image, with the three published ways of averaging."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from objectflow.evaluation.metrics.boundary import count_near, outlines, tolerance_pixels
from objectflow.evaluation.metrics.region_matching import Regions, assign_regions, compare
from objectflow.typing import LabelImage

EXTRACTED = 0.75
"""Minimum F-measure of an extracted object."""


class PRF(NamedTuple):
    """Precision, recall and F-measure, 0..1."""

    precision: float
    recall: float
    f: float


class ObjectMatch(NamedTuple):
    """A true object, the predicted one that is matched to it, and their F-measure."""

    true: int
    predicted: int
    f: float


@dataclass(frozen=True)
class SegmentationScore:
    """The segmentation scores of one image.

    Attributes:
        fbms: Ochs, Malik, Brox 2014: the background is a region; an unmatched true region has P = 1 and R = 0;
            surplus predictions are ignored; P and R are means over true regions, F is their harmonic mean.
        mean_f: Bideau et al. 2018, the headline: the same matches; an unmatched region has P = R = F = 0; F is the
            mean over regions.
        overlap: Xie et al. 2020 (UOIS): without background; matched pixels over all predicted and all true pixels.
        boundary: the measure of outlines by the same authors.
        fbms_extracted: number of true objects matched in the first form with F > 0.75.
        extracted: number of true objects matched in the first form with F >= 0.75, for the headline.
        overlap_extracted: number of true objects matched in the third form with F >= 0.75.
        true_objects, predicted_objects: numbers of objects.
        matches: the matched objects of the third form.
    """

    fbms: PRF
    mean_f: PRF
    overlap: PRF
    boundary: PRF
    fbms_extracted: int
    extracted: int
    overlap_extracted: int
    true_objects: int
    predicted_objects: int
    matches: tuple[ObjectMatch, ...]


def score_segmentation(true: LabelImage, predicted: LabelImage) -> SegmentationScore:
    """Score one label image; label 0 is the background, and the numbering of objects does not matter.

    Args:
        true, predicted: (H, W) int32 labels of the current frame.

    Raises:
        ResultError: images of different sizes, or labels that are negative or not integers.
    """
    regions = compare(true, predicted)
    pairs = assign_regions(regions)
    f = regions.f
    of_objects = [f[i, j] for i, j in pairs if regions.true_ids[i] != 0]
    objects = regions.without_background()
    object_pairs = assign_regions(objects)
    matches = tuple(
        ObjectMatch(int(objects.true_ids[i]), int(objects.predicted_ids[j]), float(objects.f[i, j]))
        for i, j in object_pairs
    )
    return SegmentationScore(
        fbms=_fbms(regions, pairs),
        mean_f=_mean_f(regions, pairs),
        overlap=_overlap(objects, object_pairs),
        boundary=_boundary(true, predicted, matches),
        fbms_extracted=sum(value > EXTRACTED for value in of_objects),
        extracted=sum(value >= EXTRACTED for value in of_objects),
        overlap_extracted=sum(match.f >= EXTRACTED for match in matches),
        true_objects=len(objects.true_ids),
        predicted_objects=len(objects.predicted_ids),
        matches=matches,
    )


def harmonic_mean(precision: float, recall: float) -> float:
    """2PR / (P + R), or 0 if both are 0."""
    return 2 * precision * recall / (precision + recall) if precision + recall > 0 else 0.0


def _fbms(regions: Regions, pairs: Sequence[tuple[int, int]]) -> PRF:
    precision, recall = _precision_recall(regions, pairs)
    count = len(regions.true_ids)
    P, R = (sum(precision) + count - len(pairs)) / count, sum(recall) / count
    return PRF(P, R, harmonic_mean(P, R))


def _mean_f(regions: Regions, pairs: Sequence[tuple[int, int]]) -> PRF:
    precision, recall = _precision_recall(regions, pairs)
    count, f = len(regions.true_ids), regions.f
    return PRF(sum(precision) / count, sum(recall) / count, float(sum(f[i, j] for i, j in pairs)) / count)


def _precision_recall(regions: Regions, pairs: Sequence[tuple[int, int]]) -> tuple[list[float], list[float]]:
    precision = [float(regions.overlap[i, j] / regions.predicted_sizes[j]) for i, j in pairs]
    recall = [float(regions.overlap[i, j] / regions.true_sizes[i]) for i, j in pairs]
    return precision, recall


def _overlap(objects: Regions, pairs: Sequence[tuple[int, int]]) -> PRF:
    matched = int(sum(objects.overlap[i, j] for i, j in pairs))
    return _of_counts(matched, int(objects.predicted_sizes.sum()), matched, int(objects.true_sizes.sum()))


def _boundary(true: LabelImage, predicted: LabelImage, matches: Sequence[ObjectMatch]) -> PRF:
    true_lines, predicted_lines = outlines(true), outlines(predicted)
    height, width = true.shape
    radius = tolerance_pixels(height, width)
    near_true = near_predicted = 0
    for match in matches:
        line, guess = true_lines.get(match.true), predicted_lines.get(match.predicted)
        if line is None or guess is None:  # a mask of the whole image has no outline
            continue
        near_true += count_near(guess, line, radius, height, width)
        near_predicted += count_near(line, guess, radius, height, width)
    return _of_counts(
        near_true, sum(map(len, predicted_lines.values())), near_predicted, sum(map(len, true_lines.values()))
    )


def _of_counts(hits: int, predicted: int, found: int, true: int) -> PRF:
    """P = hits / predicted and R = found / true; P is 1 without predictions, R is 1 without true objects."""
    if predicted == 0 and true == 0:
        return PRF(1.0, 1.0, 1.0)
    P = hits / predicted if predicted else 1.0
    R = found / true if true else 1.0
    return PRF(P, R, harmonic_mean(P, R))
