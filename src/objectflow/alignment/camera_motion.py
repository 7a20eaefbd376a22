"""The camera's motion, estimated as that of the static background, and whether the camera moved at all."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from objectflow import geometry
from objectflow.alignment import fitting, registration
from objectflow.alignment.fitting import FitSettings
from objectflow.alignment.frame_pair import FramePair
from objectflow.alignment.matching import PixelMatches, inside
from objectflow.alignment.registration import RegistrationSettings
from objectflow.geometry.camera import Camera
from objectflow.geometry.depth_noise import STRUCTURED_LIGHT, DepthNoise
from objectflow.geometry.moved import STATIC_SHIFT_PX, STATIC_SIGMAS, exceeds_noise
from objectflow.geometry.resample import upsample_mask
from objectflow.settings import Settings, setting
from objectflow.typing import BoolMask, Float64Array


@dataclass(frozen=True)
class CameraMotionSettings(Settings):
    """RANSAC on matches, registration of the background, and the test against no motion."""

    width: int = setting(640, minimum=16)
    """Pixels: width at which the frames are matched."""
    trials: int = setting(250, minimum=1)
    """Minimal sets of three matches that are drawn at a time."""
    max_trials: int = setting(4000, minimum=1)
    """Maximum number of minimal sets; as many are drawn as the share of inliers calls for."""
    miss_probability: float = setting(0.001, above=0, below=1)
    """Probability of having drawn no minimal set of inliers only, below which no more are drawn."""
    judges: int = setting(500, minimum=12)
    """Maximum number of matches on which a minimal set is scored."""
    min_inliers: int = setting(12, minimum=3)
    """Minimum number of matches that follow the camera's motion."""
    max_points: int = setting(8000, minimum=6)
    """Maximum number of points that are registered."""
    static_shift_px: float = setting(STATIC_SHIFT_PX, minimum=0)
    """Pixels: a median shift below this, together with `static_sigmas`, counts as no motion."""
    static_sigmas: float = setting(STATIC_SIGMAS, minimum=0)
    """Standard deviations of depth: see `static_shift_px`."""
    min_gain_ratio: float = setting(2.0, minimum=0)
    """The motion must reduce the squared errors of matches by this factor times what it adds to others."""
    inlier_sigmas: float = setting(3.0, above=0)
    """Standard deviations: largest distance of an inlier to its match; a larger error costs no more."""
    fit: FitSettings = FitSettings()
    registration: RegistrationSettings = RegistrationSettings()


DEFAULTS = CameraMotionSettings()


def background_motion(
    pair: FramePair,
    *,
    camera: str,
    rng: np.random.Generator,
    mask: BoolMask | None = None,
    settings: CameraMotionSettings = DEFAULTS,
) -> Float64Array | None:
    """`prev_T_curr` of the static background, or None for exactly no motion.

    Args:
        pair: the frames.
        camera: "static" returns None at once, "moving" always estimates, "auto" estimates and returns None unless the
            motion exceeds the noise.
        rng: draws the minimal sets.
        mask: (H, W) bool of the current frame, of any size: what is background; everything when None.
        settings: see there.
    """
    if camera == "static":
        return None
    pair = pair.at_width(settings.width)
    frame, matches = pair.curr.frame, pair.matches
    region = np.ones(frame.depth.shape, bool)
    if mask is not None:
        matches, region = matches[inside(mask, matches, frame.camera)], upsample_mask(mask, frame.depth.shape)
    source = pair.sources.take(region, limit=settings.max_points)
    found = dominant_motion(matches, frame.camera, rng, noise=pair.noise, settings=settings)
    moved = None
    if found is not None:
        prev_T_curr, inliers = found
        moved = registration.refine(
            pair.target, source, prev_T_curr, matches=matches[inliers], settings=settings.registration
        ).prev_T_curr
    if camera == "moving":
        return np.eye(4) if moved is None else moved
    if moved is None or not _is_significant(moved, matches, source, frame.camera, pair.noise, settings):
        return None
    return moved


def dominant_motion(
    matches: PixelMatches,
    camera: Camera,
    rng: np.random.Generator,
    *,
    noise: DepthNoise = STRUCTURED_LIGHT,
    settings: CameraMotionSettings = DEFAULTS,
) -> tuple[Float64Array, BoolMask] | None:
    """The rigid motion that most matches follow, by RANSAC on triplets.

    Returns:
        (4, 4) `prev_T_curr` and (N,) bool, its inliers; None where too few matches agree.
    """
    count = len(matches.curr)
    if count < settings.min_inliers:
        return None
    sigma = noise.match_sigma(matches.curr[:, 2], camera)
    judges = rng.permutation(count)[: settings.judges]
    limit, least, drawn = settings.inlier_sigmas**2, np.inf, 0
    # No motion is always a candidate: with a camera over a table it is usually the right one.
    prev_T_curr, candidates = np.eye(4), [np.eye(4)[None]]
    while True:
        triplets = rng.integers(0, count, (settings.trials, 3))
        motions, determined = geometry.kabsch(matches.curr[triplets], matches.prev[triplets])
        motions = np.concatenate([*candidates, motions[determined]])
        # MSAC weighs an inlier by how well it fits (Torr and Zisserman 2000).
        cost = fitting.truncated_costs(motions, matches.curr[judges], matches.prev[judges], sigma[judges], limit)
        best = int(cost.argmin())
        if cost[best] < least:
            least, prev_T_curr = float(cost[best]), motions[best]
            squared = fitting.squared_errors(motions[best, None], matches.curr[judges], matches.prev[judges])
            ratio = float((squared / sigma[judges] ** 2 < limit).mean())
        drawn, candidates = drawn + settings.trials, []
        # A set of three is all inliers with probability ratio^3 (Fischler and Bolles 1981).
        if drawn >= settings.max_trials or (1 - ratio**3) ** drawn < settings.miss_probability:
            break
    for _ in range(3):
        error = np.linalg.norm(geometry.transform(prev_T_curr, matches.curr.astype(np.float64)) - matches.prev, axis=1)
        inliers = error < settings.inlier_sigmas * sigma
        if inliers.sum() < settings.min_inliers:
            return None
        prev_T_curr = fitting.fit_matches(matches[inliers], camera, noise=noise, settings=settings.fit)[0]
    return prev_T_curr, inliers


def _is_significant(
    moved: Float64Array,
    matches: PixelMatches,
    source: registration.RegistrationSource,
    camera: Camera,
    noise: DepthNoise,
    settings: CameraMotionSettings,
) -> bool:
    """Whether a background motion exceeds noise and explains more matches than it leaves unexplained."""
    shift_px, sigmas = settings.static_shift_px, settings.static_sigmas
    if not exceeds_noise(moved, source.points, camera, noise=noise, shift_px=shift_px, sigmas=sigmas):
        return False
    sigma = noise.match_sigma(matches.curr[:, 2], camera)
    with_motion = np.linalg.norm(geometry.transform(moved, matches.curr) - matches.prev, axis=1) / sigma
    without = np.linalg.norm(matches.curr - matches.prev, axis=1) / sigma
    gain = np.minimum(without**2, settings.inlier_sigmas**2) - np.minimum(with_motion**2, settings.inlier_sigmas**2)
    won, lost = np.maximum(gain, 0).sum(), np.maximum(-gain, 0).sum()
    return bool(won > settings.min_gain_ratio * lost)
