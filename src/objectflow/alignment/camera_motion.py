"""How the static background moves in the camera's frame, and whether the camera moved at all."""

from __future__ import annotations

import numpy as np

from objectflow import geometry
from objectflow.alignment import fitting, registration
from objectflow.alignment.matching import PixelMatches
from objectflow.frame import RgbdFrame
from objectflow.geometry.camera import Camera
from objectflow.geometry.depth_noise import depth_sigma, match_sigma
from objectflow.typing import BoolMask, Float64Array


def background_motion(
    matches: PixelMatches,
    target: registration.RegistrationTarget,
    curr: RgbdFrame,
    *,
    camera: str,
    rng: np.random.Generator,
) -> Float64Array | None:
    """`prev_T_curr` of the static background, or None for exactly no motion.

    Args:
        matches: of the whole image.
        target: the previous frame.
        curr: the current frame.
        camera: "static" is None at once; "moving" always estimates; "auto" estimates, and answers None unless
            the motion stands out from the noise.
        rng: draws the minimal sets.
    """
    if camera == "static":
        return None
    source = registration.make_source(curr, np.ones(curr.depth.shape, bool), limit=8000)
    still = np.eye(4)
    found = dominant_motion(matches, curr.camera, rng)
    moved = None
    if found is not None:
        prev_T_curr, inliers = found
        moved = registration.refine(target, source, prev_T_curr, matches=matches[inliers]).prev_T_curr
    if camera == "moving":
        return still if moved is None else moved
    if moved is None or not _exceeds_noise(moved, matches, source, curr.camera):
        return None
    return moved


def dominant_motion(
    matches: PixelMatches, camera: Camera, rng: np.random.Generator, *, trials: int = 250
) -> tuple[Float64Array, BoolMask] | None:
    """The rigid motion that most matches follow, by RANSAC on triplets, and who follows it; None without one."""
    count = len(matches.curr)
    if count < 12:
        return None
    sigma = match_sigma(matches.curr[:, 2], camera)
    judges = rng.permutation(count)[:500]
    triplets = rng.integers(0, count, (trials, 3))
    motions, determined = geometry.kabsch(matches.curr[triplets], matches.prev[triplets])
    # No motion is always among the candidates: in most scenes over a table it is the right one.
    motions = np.concatenate([np.eye(4)[None], motions[determined]])
    squared = fitting.squared_errors(motions, matches.curr[judges], matches.prev[judges]) / sigma[judges] ** 2
    # MSAC: an inlier counts by how well it fits (Torr and Zisserman 2000).
    best = int(np.minimum(squared, 9).sum(1).argmin())
    prev_T_curr = motions[best]
    for _ in range(3):
        error = np.linalg.norm(geometry.transform(prev_T_curr, matches.curr.astype(np.float64)) - matches.prev, axis=1)
        inliers = error < 3 * sigma
        if inliers.sum() < 12:
            return None
        prev_T_curr = fitting.fit_matches(matches[inliers], camera)[0]
    return prev_T_curr, inliers


def _exceeds_noise(
    moved: Float64Array, matches: PixelMatches, source: registration.RegistrationSource, camera: Camera
) -> bool:
    """Whether a background motion explains matches that no motion leaves unexplained, and more than it loses."""
    shift = np.linalg.norm(geometry.transform(moved, source.points) - source.points, axis=1)
    pixels = geometry.project(source.points, camera)
    carried = geometry.project(geometry.transform(moved, source.points), camera)
    slide = np.linalg.norm(carried - pixels, axis=1)
    if np.nanmedian(slide) < 0.7 and np.median(shift / depth_sigma(source.points[:, 2])) < 3:
        return False
    sigma = match_sigma(matches.curr[:, 2], camera)
    with_motion = np.linalg.norm(geometry.transform(moved, matches.curr) - matches.prev, axis=1) / sigma
    without = np.linalg.norm(matches.curr - matches.prev, axis=1) / sigma
    won = np.maximum(np.minimum(without**2, 9) - np.minimum(with_motion**2, 9), 0).sum()
    lost = np.maximum(np.minimum(with_motion**2, 9) - np.minimum(without**2, 9), 0).sum()
    return bool(won > 2 * lost)
