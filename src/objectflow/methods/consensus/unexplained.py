"""A second look at what the first round left unexplained: motions that too few matches agreed on.

Small round things turn their texture away, and dull ones have none. What they still show is where they are now and
where something vanished; alignment by depth and colour does the rest.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from objectflow import geometry
from objectflow.alignment import fitting, registration
from objectflow.alignment.likelihood import motion_cost
from objectflow.alignment.matching import PixelMatches, inside
from objectflow.frame import RgbdFrame
from objectflow.geometry.camera import Camera
from objectflow.geometry.depth_noise import match_sigma
from objectflow.geometry.resample import upsample_mask
from objectflow.methods.consensus.assignment import Assignment
from objectflow.methods.consensus.selection import MIN_GAIN
from objectflow.typing import BoolMask, Float32Array, Float64Array

MAX_REGIONS = 6
BAD_FIT = 1.0
"""Mean cost a pixel above which an object's motion is taken for wrong, and sought again."""
MAX_STARTS = 3
MAX_DISTANCE = 0.3
"""Metres; nothing is sought further away than this."""


class RecoveredObject(NamedTuple):
    """A region and the motion that explains it."""

    prev_T_curr: Float64Array
    mask: BoolMask
    matches: PixelMatches


def recover_unexplained(
    assignment: Assignment,
    masks: list[BoolMask],
    motions: list[Float64Array],
    target: registration.RegistrationTarget,
    sources: registration.RegistrationSources,
    curr: RgbdFrame,
    movers: PixelMatches,
) -> list[RecoveredObject]:
    """Motions of regions that neither the background nor any known motion explains.

    Args:
        assignment: frames and background, at the size of the masks.
        masks: of the objects known so far.
        motions: `prev_T_curr` of each.
        target: the previous frame for `rigid`.
        sources: the current frame for it.
        curr: the same frame, at the target's size.
        movers: matches that do not follow the background.
    """
    claimed = np.zeros(assignment.valid.shape, bool)
    badly_explained = []
    for mask, motion in zip(masks, motions, strict=True):
        cost = assignment.cost(motion, assignment.around(assignment.points[mask & assignment.valid]))
        if float(cost[mask].mean()) > BAD_FIT:
            badly_explained.append(mask)
        else:
            claimed |= mask
    doubtful = (assignment.background_cost >= 1.5) & assignment.valid & ~assignment.hidden & ~claimed
    for mask in badly_explained:
        doubtful &= ~mask
    regions = badly_explained + _regions(doubtful, assignment.min_pixels)
    vanished = _vanished(assignment) if regions else []
    found = []
    for region in regions:
        wide = (cv2.dilate(region.astype(np.uint8), np.ones((7, 7))) > 0) & ~claimed & assignment.valid
        own = movers[inside(wide, movers, curr.camera)]
        box = assignment.around(assignment.points[region & assignment.valid])
        source = sources.take(upsample_mask(wide, curr), limit=1000)
        best = _align(assignment, region, target, source, own, _starts(assignment, region, own, vanished))
        if best is None:
            continue
        rival = np.minimum.reduce([assignment.background_cost, *[assignment.cost(motion, box) for motion in motions]])
        if float(assignment.cost(best, box)[region].mean()) < float(rival[region].mean()) - 2 * MIN_GAIN:
            found.append(RecoveredObject(best, region, _agreeing(own, best, curr.camera)))
    return found


def _align(
    assignment: Assignment,
    region: BoolMask,
    target: registration.RegistrationTarget,
    source: registration.RegistrationSource,
    own: PixelMatches,
    starts: list[Float64Array],
) -> Float64Array | None:
    """The refined motion that explains a region best, from the most promising of several starts; None without any."""
    promising = sorted(starts, key=lambda start: -registration.evaluate_registration(target, source, start).fitness)[
        :MAX_STARTS
    ]
    refined = [
        registration.refine(target, source, start, matches=_agreeing(own, start, target.camera)).prev_T_curr
        for start in promising
    ]
    box = assignment.around(assignment.points[region & assignment.valid])
    return min(refined, key=lambda motion: float(assignment.cost(motion, box)[region].mean()), default=None)


def _regions(doubtful: BoolMask, min_pixels: int) -> list[BoolMask]:
    """The largest connected doubtful regions, without specks and rims."""
    core = cv2.morphologyEx(doubtful.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3)))
    numbers, count = ndimage.label(core, structure=np.ones((3, 3)))
    sizes = np.bincount(numbers.ravel(), minlength=count + 1)[1:]
    ranked = [n for n in np.argsort(-sizes)[:MAX_REGIONS] if sizes[n] >= min_pixels]
    return [numbers == n + 1 for n in ranked]


def _vanished(assignment: Assignment) -> list[Float32Array]:
    """Points of the previous frame that are gone: each region of them as (N, 3)."""
    points = geometry.back_project(assignment.prev.depth, assignment.prev.camera)
    cost, hidden = motion_cost(
        assignment.curr,
        points,
        geometry.inverse(assignment.background),
        (assignment.appearance[1], assignment.appearance[0]),
    )
    gone = (cost >= 1.5) & assignment.prev.valid & ~hidden
    return [points[region] for region in _regions(gone, assignment.min_pixels)]


def _starts(
    assignment: Assignment, region: BoolMask, own: PixelMatches, vanished: list[Float32Array]
) -> list[Float64Array]:
    """Where to begin: the matches' own fit and their median shift, each place where something vanished."""
    center = np.median(assignment.points[region & assignment.valid], axis=0).astype(np.float64)
    here = geometry.transform(assignment.background, center)
    starts = []
    if len(own.curr) >= 3:
        starts.append(_shifted(assignment.background, np.median(own.prev - own.curr, axis=0) - (here - center)))
    if len(own.curr) >= 6:
        starts.append(fitting.fit_matches(own, assignment.curr.camera)[0])
    for points in vanished:
        shift = np.median(points, axis=0) - here
        if np.linalg.norm(shift) < MAX_DISTANCE:
            # Rims overlap: what is newly covered lies ahead of the object, what is laid bare behind it.
            starts += [_shifted(assignment.background, shift), _shifted(assignment.background, 0.5 * shift)]
    return starts


def _shifted(background: Float64Array, shift: NDArray[np.floating]) -> Float64Array:
    moved = background.copy()
    moved[:3, 3] += shift
    return moved


def _agreeing(matches: PixelMatches, prev_T_curr: Float64Array, camera: Camera) -> PixelMatches:
    error = np.linalg.norm(geometry.transform(prev_T_curr, matches.curr) - matches.prev, axis=1)
    return matches[error < 4 * match_sigma(matches.curr[:, 2], camera)]
