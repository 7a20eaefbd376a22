"""Recovery of objects that the first round left unexplained because too few matches agree on their motion.

Small round objects rotate their texture out of view, and plain ones have none. Their present position and the places
where something vanished still constrain their motion; registration by depth and colour completes it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from scipy import ndimage

from objectflow import geometry
from objectflow.alignment.fitting import FitSettings, fit_matches
from objectflow.alignment.frame_pair import FramePair
from objectflow.alignment.matching import PixelMatches, inside
from objectflow.alignment.registration import (
    RegistrationSettings,
    RegistrationSource,
    evaluate_registration,
    refine,
)
from objectflow.geometry.camera import Camera
from objectflow.geometry.depth_noise import DepthNoise
from objectflow.geometry.resample import upsample_mask
from objectflow.methods.consensus.assignment import Assignment
from objectflow.settings import Settings, setting
from objectflow.typing import BoolMask, Float32Array, Float64Array


@dataclass(frozen=True)
class RecoverySettings(Settings):
    """What is searched again, and where."""

    max_regions: int = setting(6, minimum=0)
    """Maximum number of unexplained regions, the largest first."""
    bad_fit: float = setting(1.0, minimum=0)
    """Mean cost per pixel above which the motion of a known object counts as wrong and is searched again."""
    changed_cost: float = setting(1.5, minimum=0)
    """Cost of the background's motion from which a pixel counts as changed."""
    max_initial: int = setting(3, minimum=1)
    """Maximum number of initial motions that are registered."""
    max_distance: float = setting(0.3, above=0)
    """Metres: largest distance to a place where something vanished."""
    max_points: int = setting(1000, minimum=6)
    """Maximum number of points that are registered."""
    min_gain: float = setting(0.7, minimum=0)
    """Minimum mean cost per pixel that a recovered motion saves against the best known one."""
    agreeing_sigmas: float = setting(4.0, above=0)
    """Standard deviations: largest distance of a match that agrees with a motion."""


class RecoveredObject(NamedTuple):
    """A region and the motion that explains it."""

    prev_T_curr: Float64Array
    mask: BoolMask
    matches: PixelMatches


def recover_unexplained(
    assignment: Assignment,
    masks: list[BoolMask],
    motions: list[Float64Array],
    pair: FramePair,
    movers: PixelMatches,
    settings: RecoverySettings,
    *,
    fit: FitSettings,
    registration: RegistrationSettings,
) -> list[RecoveredObject]:
    """Motions of regions that neither the background nor any known motion explains.

    Args:
        assignment: frames and background, at the size of the masks.
        masks: of the objects known so far.
        motions: `prev_T_curr` of each.
        pair: the frames at the size of registration and matches.
        movers: matches that do not follow the background.
        settings: see there.
        fit, registration: how initial motions are fitted to matches, and how they are registered.
    """
    frame = pair.curr.frame
    claimed = np.zeros(assignment.valid.shape, bool)
    badly_explained = []
    for mask, motion in zip(masks, motions, strict=True):
        cost = assignment.cost(motion, assignment.around_mask(mask))
        if float(cost[mask].mean()) > settings.bad_fit:
            badly_explained.append(mask)
        else:
            claimed |= mask
    doubtful = (assignment.background_cost >= settings.changed_cost) & assignment.valid & ~assignment.hidden & ~claimed
    for mask in badly_explained:
        doubtful &= ~mask
    regions = badly_explained + _regions(doubtful, assignment.min_pixels, settings)
    vanished = _vanished(assignment, settings) if regions else []
    found = []
    for region in regions:
        wide = (cv2.dilate(region.astype(np.uint8), np.ones((7, 7))) > 0) & ~claimed & assignment.valid
        own = movers[inside(wide, movers, frame.camera)]
        box = assignment.around_mask(region)
        source = pair.sources.take(upsample_mask(wide, frame.depth.shape), limit=settings.max_points)
        initial = _initial_motions(assignment, region, own, vanished, settings, fit)
        best = _register(assignment, region, pair, source, own, initial, settings, registration)
        if best is None:
            continue
        rival = np.minimum.reduce([assignment.background_cost, *[assignment.cost(motion, box) for motion in motions]])
        if float(assignment.cost(best, box)[region].mean()) < float(rival[region].mean()) - settings.min_gain:
            found.append(RecoveredObject(best, region, _agreeing(own, best, frame.camera, pair.noise, settings)))
    return found


def _register(
    assignment: Assignment,
    region: BoolMask,
    pair: FramePair,
    source: RegistrationSource,
    own: PixelMatches,
    initial: list[Float64Array],
    settings: RecoverySettings,
    registration: RegistrationSettings,
) -> Float64Array | None:
    """The registered motion that explains a region best, from the most promising initial motions; None without any."""
    target = pair.target
    fitness = [evaluate_registration(target, source, start, registration).fitness for start in initial]
    order = sorted(range(len(initial)), key=lambda k: -fitness[k])
    refined = []
    for start in (initial[k] for k in order[: settings.max_initial]):
        agreeing = _agreeing(own, start, target.camera, pair.noise, settings)
        refined.append(refine(target, source, start, matches=agreeing, settings=registration).prev_T_curr)
    box = assignment.around_mask(region)
    return min(refined, key=lambda motion: float(assignment.cost(motion, box)[region].mean()), default=None)


def _regions(doubtful: BoolMask, min_pixels: int, settings: RecoverySettings) -> list[BoolMask]:
    """The largest connected regions of a mask, without specks and rims."""
    core = cv2.morphologyEx(doubtful.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3)))
    numbers, count = ndimage.label(core, structure=np.ones((3, 3)))
    sizes = np.bincount(numbers.ravel(), minlength=count + 1)[1:]
    ranked = [n for n in np.argsort(-sizes)[: settings.max_regions] if sizes[n] >= min_pixels]
    return [numbers == n + 1 for n in ranked]


def _vanished(assignment: Assignment, settings: RecoverySettings) -> list[Float32Array]:
    """Points of the previous frame that are gone, as (N, 3) metres per region."""
    prev = assignment.pair.prev
    cost, hidden = assignment.vanished_cost()
    gone = (cost >= settings.changed_cost) & prev.valid & ~hidden
    return [prev.points[region] for region in _regions(gone, assignment.min_pixels, settings)]


def _initial_motions(
    assignment: Assignment,
    region: BoolMask,
    own: PixelMatches,
    vanished: list[Float32Array],
    settings: RecoverySettings,
    fit: FitSettings,
) -> list[Float64Array]:
    """Initial motions: the fit to the matches, their median shift, and shifts to where something vanished."""
    camera = assignment.pair.curr.frame.camera
    center = np.median(assignment.points[region & assignment.valid], axis=0).astype(np.float64)
    here = geometry.transform(assignment.background, center)
    initial = []
    if len(own.curr) >= 3:
        initial.append(_shifted(assignment.background, np.median(own.prev - own.curr, axis=0) - (here - center)))
    if len(own.curr) >= 6:
        initial.append(fit_matches(own, camera, noise=assignment.pair.noise, settings=fit)[0])
    for points in vanished:
        shift = np.median(points, axis=0) - here
        if np.linalg.norm(shift) < settings.max_distance:
            # The rim that an object newly covers lies ahead of it and the uncovered one behind, so a shift between
            # two rims is up to twice too long.
            initial += [_shifted(assignment.background, shift), _shifted(assignment.background, 0.5 * shift)]
    return initial


def _shifted(background: Float64Array, shift: Float64Array | Float32Array) -> Float64Array:
    moved = background.copy()
    moved[:3, 3] += shift
    return moved


def _agreeing(
    matches: PixelMatches, prev_T_curr: Float64Array, camera: Camera, noise: DepthNoise, settings: RecoverySettings
) -> PixelMatches:
    """The matches that agree with a motion."""
    error = np.linalg.norm(geometry.transform(prev_T_curr, matches.curr) - matches.prev, axis=1)
    return matches[error < settings.agreeing_sigmas * noise.match_sigma(matches.curr[:, 2], camera)]
