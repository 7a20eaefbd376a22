"""End-point error and average angular error of the scene flow of one image."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from objectflow.errors import ResultError
from objectflow.typing import BoolMask, Float32Array, Float64Array

THRESHOLDS_CM = (1.0, 5.0, 10.0)
"""End-point errors, cm, below which the share of pixels is reported."""

_NAN = float("nan")


@dataclass(frozen=True)
class PixelScore:
    """The flow errors on one set of an image's pixels.

    Attributes:
        epe_cm: mean L2 norm of the 3D difference; NaN if no pixel has both truth and prediction.
        aae_deg: mean angle between (u, v, w, 1) of prediction and truth in metres; NaN in the same case.
        pixels: number of pixels with truth.
        predicted: number of these that also have a prediction; `predicted / pixels` is a sparse method's density.
        under: number of these with an end-point error below each of `THRESHOLDS_CM`. Shares are relative to `pixels`,
            so a pixel without a prediction counts as a miss.
    """

    epe_cm: float
    aae_deg: float
    pixels: int
    predicted: int
    under: tuple[int, ...]


@dataclass(frozen=True)
class FlowScore:
    """The flow errors of one image: on all pixels with depth, on objects visible in both frames, on moving ones."""

    all: PixelScore
    masked: PixelScore
    moving: PixelScore


def score_flow(predicted: Float32Array, true: Float32Array, masked: BoolMask, moving: BoolMask) -> FlowScore:
    """Score the scene flow of one image.

    Args:
        predicted, true: (H, W, 3) metres, NaN where there is no flow.
        masked: (H, W) bool: pixels of objects that are visible in both frames.
        moving: (H, W) bool: pixels of objects that move.

    Raises:
        ResultError: arrays of different sizes.
    """
    if predicted.shape != true.shape or true.ndim != 3 or true.shape[2] != 3:
        raise ResultError(f"predicted flow {predicted.shape} does not fit true flow {true.shape}")
    if masked.shape != true.shape[:2] or moving.shape != true.shape[:2]:
        raise ResultError(f"masks {masked.shape} and {moving.shape} do not fit flow {true.shape}")
    known = _finite(true)
    scored = known & _finite(predicted)
    a, b = _components(predicted, scored), _components(true, scored)
    epe = end_point_errors(a, b)
    aae = angular_errors(a, b)
    everything, some = np.ones(len(epe), np.bool_), masked & known
    return FlowScore(
        all=_pixel_score(epe, aae, everything, int(known.sum())),
        masked=_pixel_score(epe, aae, some[scored], int(some.sum())),
        moving=_pixel_score(epe, aae, (some & moving)[scored], int((some & moving).sum())),
    )


def end_point_errors(predicted: Float64Array, true: Float64Array) -> Float64Array:
    """(N,) L2 distances in cm of two (3, N) flows in metres."""
    du, dv, dw = predicted - true
    return np.asarray(100 * np.sqrt(du * du + dv * dv + dw * dw))


def angular_errors(predicted: Float64Array, true: Float64Array) -> Float64Array:
    """(N,) angles in degrees between (u, v, w, 1) of two (3, N) flows in metres.

    The angle is the arctangent of sine over cosine, since an arccosine is inaccurate for small angles. The square of
    |a||b| sin is the sum of the squared 2x2 minors: |p - t|^2 for the three with the ones, |p x t|^2 for the others.
    """
    (u, v, w), (x, y, z) = predicted, true
    minors = (u - x) ** 2 + (v - y) ** 2 + (w - z) ** 2
    minors += (v * z - w * y) ** 2 + (w * x - u * z) ** 2 + (u * y - v * x) ** 2
    return np.asarray(np.degrees(np.arctan2(np.sqrt(minors), u * x + v * y + w * z + 1)))


def _components(flow: Float32Array, scored: BoolMask) -> Float64Array:
    """(3, N) contiguous components u, v, w of the selected pixels, on which the metrics are twice as fast."""
    flat = flow.reshape(-1, 3)
    return np.ascontiguousarray((flat if scored.all() else flat[scored.ravel()]).T, dtype=np.float64)


def _finite(flow: Float32Array) -> BoolMask:
    finite = np.isfinite(flow)
    return np.asarray(finite[..., 0] & finite[..., 1] & finite[..., 2])


def _pixel_score(epe: Float64Array, aae: Float64Array, pick: BoolMask, pixels: int) -> PixelScore:
    epe, aae = epe[pick], aae[pick]
    under = tuple(int((epe < limit).sum()) for limit in THRESHOLDS_CM)
    if len(epe) == 0:
        return PixelScore(_NAN, _NAN, pixels, 0, under)
    return PixelScore(float(epe.mean()), float(aae.mean()), pixels, len(epe), under)
