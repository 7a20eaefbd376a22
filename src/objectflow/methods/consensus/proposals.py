"""Proposals: rigid motions of groups of matches whose mutual distances are preserved."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from objectflow import geometry
from objectflow.alignment import fitting
from objectflow.alignment.fitting import FitSettings
from objectflow.alignment.matching import PixelMatches
from objectflow.geometry.camera import Camera
from objectflow.geometry.depth_noise import DepthNoise
from objectflow.settings import Settings, setting
from objectflow.typing import BoolMask, Float64Array


@dataclass(frozen=True)
class ProposalSettings(Settings):
    """Settings of `propose`."""

    max_motions: int = setting(24, minimum=1)
    """Maximum number of proposed motions."""
    min_support: int = setting(6, minimum=3)
    """Minimum number of inlier matches of a motion."""
    max_matches: int = setting(700, minimum=3)
    """Maximum number of matches; more are subsampled at random, since the compatibility table is quadratic."""
    min_support_ratio: float = setting(0.5, minimum=0, maximum=1)
    """Smallest support of a motion relative to the best of the same table."""
    min_free_share: float = setting(0.8, minimum=0, maximum=1)
    """Smallest share of a motion's matches that no other motion of the same table has taken."""
    reach_base: float = setting(0.05, minimum=0)
    """Maximum distance in metres between two matches of one motion, at depth 0."""
    reach_slope: float = setting(0.35, minimum=0)
    """Increase of that distance per metre of median depth."""
    distance_sigmas: float = setting(2.0, above=0)
    """Standard deviations: largest change of a distance between two matches of one motion."""
    inlier_sigmas: float = setting(3.0, above=0)
    """Standard deviations: largest error of an inlier."""
    weight_sigmas: float = setting(4.0, above=0)
    """Standard deviations from which a match has no weight in the fits, and up to which it counts as explained."""
    member_distance: float = setting(0.08, minimum=0)
    """Metres: largest distance of an explained match to an inlier of the motion."""


DEFAULTS = ProposalSettings()


class Proposal(NamedTuple):
    """A motion and its inlier matches."""

    prev_T_curr: Float64Array
    matches: PixelMatches


def propose(
    matches: PixelMatches,
    camera: Camera,
    *,
    rng: np.random.Generator,
    noise: DepthNoise,
    fit: FitSettings,
    settings: ProposalSettings = DEFAULTS,
) -> list[Proposal]:
    """Propose motions by greedy maximum coverage: repeatedly the motion with most inliers among remaining matches.

    Each match yields one candidate, fitted to the neighbours whose distance to it is equal in both frames, since a
    rigid motion preserves distances (the consistency criterion of SF2SE3, GCPR 2022, section 3.2).

    Args:
        matches: matches that are not inliers of the background's motion.
        camera: converts the matching error to metres.
        rng: subsamples the matches if there are more than `max_matches`.
        noise: depth noise model.
        fit: how a motion is fitted to its inliers.
        settings: the settings.
    """
    if len(matches.curr) > settings.max_matches:
        matches = matches[np.sort(rng.permutation(len(matches.curr))[: settings.max_matches])]
    left = matches
    found: list[Proposal] = []
    while len(found) < settings.max_motions and len(left.curr) >= settings.min_support:
        follows, scores = _candidates(left, camera, noise, settings)
        if len(scores) == 0 or scores.max() < settings.min_support:
            break
        # Several motions are taken from one table if their inliers do not overlap.
        free = np.ones(len(left.curr), bool)
        taken_here = 0
        for index in np.argsort(-scores):
            if (
                scores[index] < max(settings.min_support, settings.min_support_ratio * scores.max())
                or len(found) == settings.max_motions
            ):
                break
            members = follows[index]
            if (members & free).sum() < settings.min_free_share * members.sum() or (
                members & free
            ).sum() < settings.min_support:
                continue
            prev_T_curr, inliers = fitting.fit_matches(left[members & free], camera, noise=noise, settings=fit)
            if inliers.sum() < settings.min_support:
                continue
            found.append(Proposal(prev_T_curr, left[members & free][inliers]))
            free &= ~_explained(prev_T_curr, left, camera, noise, found[-1].matches, settings)
            free &= ~members
            taken_here += 1
        if taken_here == 0:
            break
        left = left[free]
    return found


def _candidates(
    matches: PixelMatches, camera: Camera, noise: DepthNoise, settings: ProposalSettings
) -> tuple[BoolMask, Float64Array]:
    """Fit one motion per match: (K, N) bool inliers, and (K,) their number weighted by the quality of fit."""
    curr, prev = matches.curr.astype(np.float64), matches.prev.astype(np.float64)
    sigma = noise.match_sigma(matches.curr[:, 2], camera).astype(np.float64)
    near = _distances(curr)
    reach = settings.reach_slope * np.median(curr[:, 2]) + settings.reach_base
    compatible = np.abs(near - _distances(prev)) < settings.distance_sigmas * np.hypot(sigma[:, None], sigma[None, :])
    compatible &= near < reach
    # Distant neighbours determine the rotation, so the weight falls slowly with distance.
    weights: Float64Array = np.where(compatible, np.exp(-((near / (0.5 * reach)) ** 2)), 0.0)
    motions, determined = _fit_all(weights, curr, prev)
    for _ in range(3):
        error = _errors(motions, curr, prev) / sigma
        weights = np.where(near < reach, np.clip(1 - (error / settings.weight_sigmas) ** 2, 0, None) ** 2, 0.0)
        motions, determined = _fit_all(weights, curr, prev)
    error = _errors(motions, curr, prev) / sigma
    limit = settings.inlier_sigmas
    follows = (error < limit) & (near < reach) & determined[:, None]
    scores = (follows * (1 - (np.minimum(error, limit) / limit) ** 2)).sum(1)
    return follows, scores


def _fit_all(weights: Float64Array, curr: Float64Array, prev: Float64Array) -> tuple[Float64Array, BoolMask]:
    """Fit one point set under K weightings (Kabsch) from moments, which avoids an array of shape (K, N, 3)."""
    total = weights.sum(1, keepdims=True) + 1e-12
    w = weights / total
    p_mean, q_mean = w @ curr, w @ prev
    outer = (prev[:, :, None] * curr[:, None, :]).reshape(len(curr), 9)
    H = (w @ outer).reshape(-1, 3, 3) - q_mean[:, :, None] * p_mean[:, None, :]
    R, S = geometry.nearest_rotation(H)
    t = q_mean - (R @ p_mean[..., None])[..., 0]
    enough = ((weights > 0.01).sum(1) >= 4) & (S[:, 1] > 1e-3 * S[:, 0]) & (S[:, 0] > 1e-8)
    return geometry.make_transform(R, t), enough


def _errors(motions: Float64Array, curr: Float64Array, prev: Float64Array) -> Float64Array:
    """(K, N) errors in metres of each match under each motion."""
    return np.sqrt(fitting.squared_errors(motions, curr, prev))


def _distances(points: Float64Array) -> Float64Array:
    """(N, 3) points -> (N, N) mutual distances in metres."""
    square = (points**2).sum(1)
    return np.asarray(np.sqrt(np.maximum(square[:, None] + square[None, :] - 2 * points @ points.T, 0)))


def _explained(
    prev_T_curr: Float64Array,
    matches: PixelMatches,
    camera: Camera,
    noise: DepthNoise,
    members: PixelMatches,
    settings: ProposalSettings,
) -> BoolMask:
    """(N,) bool: matches consistent with a motion and near one of its members."""
    sigma = noise.match_sigma(matches.curr[:, 2], camera)
    error = np.linalg.norm(geometry.transform(prev_T_curr, matches.curr) - matches.prev, axis=1)
    gap = np.linalg.norm(matches.curr[:, None] - members.curr[None], axis=-1).min(1)
    return np.asarray((error < settings.weight_sigmas * sigma) & (gap < settings.member_distance))
