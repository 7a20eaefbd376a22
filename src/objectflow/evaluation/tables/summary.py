"""Summary of a method's scores over a set: the numbers of the tables, each with its interval."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.random import Generator

from objectflow.evaluation.metrics.flow_metrics import THRESHOLDS_CM, PixelScore
from objectflow.evaluation.metrics.mover_metrics import MoverScore
from objectflow.evaluation.metrics.pair_score import PairScore
from objectflow.evaluation.metrics.segmentation_metrics import PRF, SegmentationScore
from objectflow.evaluation.runtime import Runtime, summarise_runtime
from objectflow.evaluation.tables.bootstrap import Bootstrap, Interval


@dataclass(frozen=True)
class FlowSummary:
    """The flow errors on one kind of pixels, over a set of pairs.

    Attributes:
        epe_cm, aae_deg: means over images of the images' means; images without such pixels are excluded.
        epe_std, aae_std: standard deviations over images.
        under: shares of all pixels of the set with an end-point error below 1, 5 and 10 cm.
        density: share of all pixels of the set that have a prediction.
        images: number of images included.
    """

    epe_cm: Interval
    aae_deg: Interval
    epe_std: float
    aae_std: float
    under: tuple[Interval, ...]
    density: Interval
    images: int


@dataclass(frozen=True)
class SegmentationSummary:
    """One form of the segmentation scores over a set of pairs; `extracted` counts out of `true_objects`."""

    precision: Interval
    recall: Interval
    f: Interval
    extracted: int
    true_objects: int
    extracted_share: Interval


@dataclass(frozen=True)
class ObjectSummary:
    """The motion errors of all matched objects of a set.

    Attributes:
        rotation_deg, translation_cm: medians.
        good: share of objects under 5 degrees and 2 cm.
        matched: number of matched objects.
    """

    rotation_deg: Interval
    translation_cm: Interval
    good: Interval
    matched: int


@dataclass(frozen=True)
class MoverSummary:
    """The detection of all moving objects of a set.

    Attributes:
        precision: share of the objects predicted to move that are matched to a moving object with F >= 0.75.
        recall: share of the moving objects that are found in this way.
        true, found: number of moving objects, and of those found.
        no_false_mover: share of the pairs without motion in which no object is predicted to move.
        static_pairs: number of pairs without motion.
    """

    precision: Interval
    recall: Interval
    true: int
    found: int
    no_false_mover: Interval
    static_pairs: int


@dataclass(frozen=True)
class Summary:
    """The scores of one method on a set.

    Attributes:
        pairs, scenes: numbers of scored pairs and of their scenes.
        flow_all, flow_masked, flow_moving: on all pixels, on objects visible in both frames, on moving objects.
        mean_f: the headline form. fbms, overlap: the other two forms. boundary: with the overlap's `extracted`.
        objects: motions of matched objects.
        movers: moving objects, found and false ones.
        runtime: seconds per pair.
    """

    pairs: int
    scenes: int
    flow_all: FlowSummary
    flow_masked: FlowSummary
    flow_moving: FlowSummary
    mean_f: SegmentationSummary
    fbms: SegmentationSummary
    overlap: SegmentationSummary
    boundary: SegmentationSummary
    objects: ObjectSummary
    movers: MoverSummary
    runtime: Runtime = field(compare=False)


def summarise(scores: Sequence[PairScore], rng: Generator, *, warm_up: int = 1, machine: str | None = None) -> Summary:
    """Average the scores of one method over a set.

    Args:
        scores: one per pair, in the order of their runs.
        rng: for the bootstrap.
        warm_up, machine: see `summarise_runtime`.

    Raises:
        DatasetError: no scores.
    """
    bootstrap = Bootstrap([score.scene for score in scores], rng)
    segmentation = [score.segmentation for score in scores]
    return Summary(
        pairs=len(scores),
        scenes=len({score.scene for score in scores}),
        flow_all=_flow(bootstrap, [score.flow.all for score in scores]),
        flow_masked=_flow(bootstrap, [score.flow.masked for score in scores]),
        flow_moving=_flow(bootstrap, [score.flow.moving for score in scores]),
        mean_f=_segmentation(bootstrap, segmentation, lambda s: s.mean_f, lambda s: s.extracted),
        fbms=_segmentation(bootstrap, segmentation, lambda s: s.fbms, lambda s: s.fbms_extracted, harmonic=True),
        overlap=_segmentation(bootstrap, segmentation, lambda s: s.overlap, lambda s: s.overlap_extracted),
        boundary=_segmentation(bootstrap, segmentation, lambda s: s.boundary, lambda s: s.overlap_extracted),
        objects=_objects(bootstrap, scores),
        movers=_movers(bootstrap, [score.movers for score in scores]),
        runtime=summarise_runtime([score.seconds for score in scores], warm_up=warm_up, machine=machine),
    )


def _flow(bootstrap: Bootstrap, scores: Sequence[PixelScore]) -> FlowSummary:
    epe = np.array([score.epe_cm for score in scores])
    aae = np.array([score.aae_deg for score in scores])
    pixels = [score.pixels for score in scores]
    finite = np.isfinite(epe)
    return FlowSummary(
        epe_cm=bootstrap.mean(epe),
        aae_deg=bootstrap.mean(aae),
        epe_std=float(epe[finite].std()) if finite.any() else float("nan"),
        aae_std=float(aae[finite].std()) if finite.any() else float("nan"),
        under=tuple(bootstrap.ratio([score.under[k] for score in scores], pixels) for k in range(len(THRESHOLDS_CM))),
        density=bootstrap.ratio([score.predicted for score in scores], pixels),
        images=int(finite.sum()),
    )


def _segmentation(
    bootstrap: Bootstrap,
    scores: Sequence[SegmentationScore],
    form: Callable[[SegmentationScore], PRF],
    extracted: Callable[[SegmentationScore], int],
    *,
    harmonic: bool = False,
) -> SegmentationSummary:
    precision, recall, f = zip(*(form(score) for score in scores), strict=True)
    found, true = [extracted(score) for score in scores], [score.true_objects for score in scores]
    return SegmentationSummary(
        precision=bootstrap.mean(precision),
        recall=bootstrap.mean(recall),
        f=bootstrap.harmonic(precision, recall) if harmonic else bootstrap.mean(f),
        extracted=sum(found),
        true_objects=sum(true),
        extracted_share=bootstrap.ratio(found, true),
    )


def _objects(bootstrap: Bootstrap, scores: Sequence[PairScore]) -> ObjectSummary:
    owners = [index for index, score in enumerate(scores) for _ in score.objects]
    errors = [error for score in scores for error in score.objects]
    good = [sum(error.good for error in score.objects) for score in scores]
    return ObjectSummary(
        rotation_deg=bootstrap.median([error.rotation_deg for error in errors], owners),
        translation_cm=bootstrap.median([error.translation_cm for error in errors], owners),
        good=bootstrap.ratio(good, [len(score.objects) for score in scores]),
        matched=len(errors),
    )


def _movers(bootstrap: Bootstrap, scores: Sequence[MoverScore]) -> MoverSummary:
    found, true = [score.found for score in scores], [score.true for score in scores]
    static = [score.static for score in scores]
    return MoverSummary(
        precision=bootstrap.ratio(found, [score.predicted for score in scores]),
        recall=bootstrap.ratio(found, true),
        true=sum(true),
        found=sum(found),
        no_false_mover=bootstrap.ratio([score.static and not score.false_mover for score in scores], static),
        static_pairs=sum(static),
    )
