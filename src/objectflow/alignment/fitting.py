"""A rigid motion fitted to matches: minimal sets, inliers and a weighted refit."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from objectflow import geometry
from objectflow.alignment.matching import PixelMatches
from objectflow.alignment.registration import TUKEY
from objectflow.alignment.robust import median, tukey_weights
from objectflow.geometry.camera import Camera
from objectflow.geometry.depth_noise import STRUCTURED_LIGHT, DepthNoise
from objectflow.settings import Settings, setting
from objectflow.typing import BoolMask, Float32Array, Float64Array


@dataclass(frozen=True)
class FitSettings(Settings):
    """How a rigid motion is fitted to matches (`fit_matches`)."""

    trials: int = setting(40, minimum=1)
    """Minimal sets of three matches among which the first fit is chosen."""
    iterations: int = setting(8, minimum=0)
    """Maximum number of reweighted fits after it."""
    tukey: float = setting(TUKEY, above=0)
    """Standard deviations from which a match has no weight (Tukey's biweight)."""
    inlier_sigmas: float = setting(3.0, above=0)
    """Standard deviations: largest distance of an inlier to its match."""


DEFAULTS = FitSettings()

_BLOCK = 16384
"""Products of motions and points per block in `truncated_costs`."""


def fit_matches(
    matches: PixelMatches,
    camera: Camera,
    *,
    weights: Float32Array | None = None,
    noise: DepthNoise = STRUCTURED_LIGHT,
    settings: FitSettings = DEFAULTS,
) -> tuple[Float64Array, BoolMask]:
    """The rigid motion of matches: Kabsch's fit, reweighted by Tukey's biweight.

    Args:
        matches: at least three, most of them from one object.
        camera: its focal length converts the matching error from pixels to metres.
        weights: (N,) prior weights; ones when None.
        noise: of the depth.
        settings: see there.

    Returns:
        (4, 4) `prev_T_curr`, and (N,) bool: the inliers.
    """
    prior = np.ones(len(matches.curr)) if weights is None else weights.astype(np.float64)
    sigma = noise.match_sigma(matches.curr[:, 2], camera).astype(np.float64)
    # Maximum likelihood weighs precise points more.
    precision = prior / sigma**2
    prev_T_curr = _rough_fit(matches, sigma, precision, settings)
    for _ in range(settings.iterations):
        error = np.linalg.norm(geometry.transform(prev_T_curr, matches.curr.astype(np.float64)) - matches.prev, axis=1)
        scaled = error / sigma
        scale = max(1.0, 1.4826 * median(scaled))
        robust = tukey_weights(scaled, settings.tukey * scale)
        if (robust > 0).sum() < 3:
            break
        updated, determined = geometry.kabsch(matches.curr, matches.prev, precision * robust)
        if not determined:
            break
        change = np.abs(updated - prev_T_curr).max()
        prev_T_curr = updated
        if change < 1e-7:
            break
    error = np.linalg.norm(geometry.transform(prev_T_curr, matches.curr.astype(np.float64)) - matches.prev, axis=1)
    return prev_T_curr, error < settings.inlier_sigmas * sigma


def _rough_fit(
    matches: PixelMatches, sigma: Float64Array, precision: Float64Array, settings: FitSettings
) -> Float64Array:
    """The best, by truncated squares, of the fit to all matches and of fits to triplets.

    Triplets step through the list with varying strides, so the result is deterministic.
    """
    count = len(matches.curr)
    trials, limit = settings.trials, settings.inlier_sigmas**2
    trial = np.arange(trials)
    stride = 1 + (trial * 37) % max(1, count // 2)
    triplets = (trial[:, None] * count // trials + stride[:, None] * np.arange(3)) % count
    motions, determined = geometry.kabsch(matches.curr[triplets], matches.prev[triplets])
    everything, _ = geometry.kabsch(matches.curr, matches.prev, precision)
    motions = np.concatenate([everything[None], motions[determined]])
    return np.asarray(motions[truncated_costs(motions, matches.curr, matches.prev, sigma, limit).argmin()])


def truncated_costs(
    motions: Float64Array,
    curr: NDArray[np.floating[Any]],
    prev: NDArray[np.floating[Any]],
    sigma: NDArray[np.floating[Any]],
    limit: float,
) -> Float64Array:
    """The sum over points of the squared distance to the match, relative to its variance and at most a limit.

    Args:
        motions: (K, 4, 4) `prev_T_curr`.
        curr, prev: (N, 3) metres.
        sigma: (N,) metres, standard deviation of each match.
        limit: highest cost of a point.

    Returns:
        (K,) costs.
    """
    # Blocks that fit into the processor's cache take less than half the time.
    size, variance = max(1, _BLOCK // max(1, len(curr))), sigma**2
    costs = [
        np.minimum(squared_errors(motions[start : start + size], curr, prev) / variance, limit).sum(axis=1)
        for start in range(0, len(motions), size)
    ]
    return np.concatenate(costs)


def squared_errors(
    motions: Float64Array, curr: NDArray[np.floating[Any]], prev: NDArray[np.floating[Any]]
) -> Float64Array:
    """Squared distance of every point, moved by every motion, to its match.

    Args:
        motions: (K, 4, 4) `prev_T_curr`.
        curr, prev: (N, 3) metres.

    Returns:
        (K, N) square metres.
    """
    # Coordinates come first, so that sums over them run along long rows.
    off = motions[:, :3, :3] @ curr.T.astype(np.float64) + (motions[:, :3, 3, None] - prev.T)
    off *= off
    return np.asarray(off[:, 0] + off[:, 1] + off[:, 2])
