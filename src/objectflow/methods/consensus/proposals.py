"""Rigid motions of moving objects, from matches that keep their distances to each other."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from objectflow import geometry
from objectflow.alignment import fitting
from objectflow.alignment.matching import PixelMatches
from objectflow.geometry.camera import Camera
from objectflow.geometry.depth_noise import match_sigma
from objectflow.typing import BoolMask, Float64Array


class Proposal(NamedTuple):
    """A motion and the matches that follow it."""

    prev_T_curr: Float64Array
    matches: PixelMatches


def propose(
    matches: PixelMatches,
    camera: Camera,
    *,
    rng: np.random.Generator,
    limit: int = 24,
    min_support: int = 6,
    max_matches: int = 700,
) -> list[Proposal]:
    """Greedy maximum coverage: again and again the motion that explains most of the matches left.

    Every match proposes one motion: the fit to its neighbours that are as far from it in one frame as in the other,
    since a rigid motion keeps distances (the consistency of SF2SE3, GCPR 2022, section 3.2).

    Args:
        matches: those that do not follow the background.
        camera: for the matching error in metres.
        rng: thins the matches when there are more than `max_matches`.
        limit: at most this many motions.
        min_support: fewer matches than this make no motion.
        max_matches: the compatibility table has this many rows.
    """
    if len(matches.curr) > max_matches:
        matches = matches[np.sort(rng.permutation(len(matches.curr))[:max_matches])]
    left = matches
    found: list[Proposal] = []
    while len(found) < limit and len(left.curr) >= min_support:
        follows, scores = _candidates(left, camera)
        if len(scores) == 0 or scores.max() < min_support:
            break
        # One table serves several motions, as long as their followers do not overlap.
        free = np.ones(len(left.curr), bool)
        taken_here = 0
        for index in np.argsort(-scores):
            if scores[index] < max(min_support, 0.5 * scores.max()) or len(found) == limit:
                break
            members = follows[index]
            if (members & free).sum() < 0.8 * members.sum() or (members & free).sum() < min_support:
                continue
            prev_T_curr, inliers = fitting.fit_matches(left[members & free], camera)
            if inliers.sum() < min_support:
                continue
            found.append(Proposal(prev_T_curr, left[members & free][inliers]))
            free &= ~_explained(prev_T_curr, left, camera, found[-1].matches)
            free &= ~members
            taken_here += 1
        if taken_here == 0:
            break
        left = left[free]
    return found


def _candidates(matches: PixelMatches, camera: Camera) -> tuple[BoolMask, Float64Array]:
    """One motion a match: who follows it (K, N), and how many do, weighted by how well."""
    curr, prev = matches.curr.astype(np.float64), matches.prev.astype(np.float64)
    sigma = match_sigma(matches.curr[:, 2], camera).astype(np.float64)
    near = _distances(curr)
    reach = 0.35 * np.median(curr[:, 2]) + 0.05
    compatible = np.abs(near - _distances(prev)) < 2 * np.hypot(sigma[:, None], sigma[None, :])
    compatible &= near < reach
    # Neighbours at a lever arm fix the rotation; a third of the reach already counts in full.
    weights: Float64Array = np.where(compatible, np.exp(-((near / (0.5 * reach)) ** 2)), 0.0)
    motions, determined = _fit_all(weights, curr, prev)
    for _ in range(3):
        error = _errors(motions, curr, prev) / sigma
        weights = np.where(near < reach, np.clip(1 - (error / 4) ** 2, 0, None) ** 2, 0.0)
        motions, determined = _fit_all(weights, curr, prev)
    error = _errors(motions, curr, prev) / sigma
    follows = (error < 3) & (near < reach) & determined[:, None]
    scores = (follows * (1 - (np.minimum(error, 3) / 3) ** 2)).sum(1)
    return follows, scores


def _fit_all(weights: Float64Array, curr: Float64Array, prev: Float64Array) -> tuple[Float64Array, BoolMask]:
    """Weighted Kabsch of one point set under K weightings, by moments: no (K, N, 3) array is made."""
    total = weights.sum(1, keepdims=True) + 1e-12
    w = weights / total
    p_mean, q_mean = w @ curr, w @ prev
    outer = (prev[:, :, None] * curr[:, None, :]).reshape(len(curr), 9)
    H = (w @ outer).reshape(-1, 3, 3) - q_mean[:, :, None] * p_mean[:, None, :]
    U, S, Vt = np.linalg.svd(H)
    D = np.ones((len(H), 3))
    D[:, 2] = np.sign(np.linalg.det(U @ Vt))
    R = (U * D[:, None, :]) @ Vt
    t = q_mean - (R @ p_mean[..., None])[..., 0]
    enough = ((weights > 0.01).sum(1) >= 4) & (S[:, 1] > 1e-3 * S[:, 0]) & (S[:, 0] > 1e-8)
    return geometry.make_transform(R, t), enough


def _errors(motions: Float64Array, curr: Float64Array, prev: Float64Array) -> Float64Array:
    """(K, N) distances of every match to its place under every motion."""
    return np.sqrt(fitting.squared_errors(motions, curr, prev))


def _distances(points: Float64Array) -> Float64Array:
    square = (points**2).sum(1)
    return np.asarray(np.sqrt(np.maximum(square[:, None] + square[None, :] - 2 * points @ points.T, 0)))


def _explained(prev_T_curr: Float64Array, matches: PixelMatches, camera: Camera, members: PixelMatches) -> BoolMask:
    """Matches that a motion explains and that lie near one of its own."""
    sigma = match_sigma(matches.curr[:, 2], camera)
    error = np.linalg.norm(geometry.transform(prev_T_curr, matches.curr) - matches.prev, axis=1)
    gap = np.linalg.norm(matches.curr[:, None] - members.curr[None], axis=-1).min(1)
    return np.asarray((error < 4 * sigma) & (gap < 0.08))
