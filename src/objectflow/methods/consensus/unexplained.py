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
from objectflow.alignment.matching import Matches, inside
from objectflow.frame import RgbdFrame
from objectflow.geometry.camera import Camera
from objectflow.geometry.depth_noise import match_sigma
from objectflow.geometry.resample import enlarge
from objectflow.methods.consensus.assignment import Stage
from objectflow.methods.consensus.selection import MIN_GAIN

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

MAX_REGIONS = 6
BAD_FIT = 1.0
"""Mean cost a pixel above which an object's motion is taken for wrong, and sought again."""
MAX_STARTS = 3
REACH = 0.3
"""Metres; nothing is sought further away than this."""


class Found(NamedTuple):
    """A region and the motion that explains it."""

    prev_T_curr: Array
    mask: Mask
    matches: Matches


def seek(
    stage: Stage,
    masks: list[Mask],
    motions: list[Array],
    target: registration.Target,
    sources: registration.Sources,
    curr: RgbdFrame,
    movers: Matches,
) -> list[Found]:
    """Motions of regions that neither the background nor any known motion explains.

    Args:
        stage: frames and background, at the size of the masks.
        masks: of the objects known so far.
        motions: `prev_T_curr` of each.
        target: the previous frame for `rigid`.
        sources: the current frame for it.
        curr: the same frame, at the target's size.
        movers: matches that do not follow the background.
    """
    claimed = np.zeros(stage.valid.shape, bool)
    badly_explained = []
    for mask, motion in zip(masks, motions, strict=True):
        cost = stage.cost(motion, stage.around(stage.points[mask & stage.valid]))
        if float(cost[mask].mean()) > BAD_FIT:
            badly_explained.append(mask)
        else:
            claimed |= mask
    doubtful = (stage.background_cost >= 1.5) & stage.valid & ~stage.hidden & ~claimed
    for mask in badly_explained:
        doubtful &= ~mask
    regions = badly_explained + _regions(doubtful, stage.min_pixels)
    vanished = _vanished(stage) if regions else []
    found = []
    for region in regions:
        wide = (cv2.dilate(region.astype(np.uint8), np.ones((7, 7))) > 0) & ~claimed & stage.valid
        own = movers[inside(wide, movers, curr.camera)]
        box = stage.around(stage.points[region & stage.valid])
        source = sources.take(enlarge(wide, curr), limit=1000)
        best = _align(stage, region, target, source, own, _starts(stage, region, own, vanished))
        if best is None:
            continue
        rival = np.minimum.reduce([stage.background_cost, *[stage.cost(motion, box) for motion in motions]])
        if float(stage.cost(best, box)[region].mean()) < float(rival[region].mean()) - 2 * MIN_GAIN:
            found.append(Found(best, region, _agreeing(own, best, curr.camera)))
    return found


def _align(
    stage: Stage,
    region: Mask,
    target: registration.Target,
    source: registration.Source,
    own: Matches,
    starts: list[Array],
) -> Array | None:
    """The refined motion that explains a region best, from the most promising of several starts; None without any."""
    promising = sorted(starts, key=lambda start: -registration.judge(target, source, start).explained)[:MAX_STARTS]
    refined = [
        registration.refine(target, source, start, matches=_agreeing(own, start, target.camera)).prev_T_curr
        for start in promising
    ]
    box = stage.around(stage.points[region & stage.valid])
    return min(refined, key=lambda motion: float(stage.cost(motion, box)[region].mean()), default=None)


def _regions(doubtful: Mask, min_pixels: int) -> list[Mask]:
    """The largest connected doubtful regions, without specks and rims."""
    core = cv2.morphologyEx(doubtful.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3)))
    numbers, count = ndimage.label(core, structure=np.ones((3, 3)))
    sizes = np.bincount(numbers.ravel(), minlength=count + 1)[1:]
    ranked = [n for n in np.argsort(-sizes)[:MAX_REGIONS] if sizes[n] >= min_pixels]
    return [numbers == n + 1 for n in ranked]


def _vanished(stage: Stage) -> list[NDArray[np.float32]]:
    """Points of the previous frame that are gone: each region of them as (N, 3)."""
    points = geometry.back_project(stage.prev.depth, stage.prev.camera)
    cost, hidden = motion_cost(
        stage.curr, points, geometry.inverse(stage.background), (stage.looks[1], stage.looks[0])
    )
    gone = (cost >= 1.5) & stage.prev.valid & ~hidden
    return [points[region] for region in _regions(gone, stage.min_pixels)]


def _starts(stage: Stage, region: Mask, own: Matches, vanished: list[NDArray[np.float32]]) -> list[Array]:
    """Where to begin: the matches' own fit and their median shift, each place where something vanished."""
    center = np.median(stage.points[region & stage.valid], axis=0).astype(np.float64)
    here = geometry.transform(stage.background, center)
    starts = []
    if len(own.curr) >= 3:
        starts.append(_shifted(stage.background, np.median(own.prev - own.curr, axis=0) - (here - center)))
    if len(own.curr) >= 6:
        starts.append(fitting.fit_matches(own, stage.curr.camera)[0])
    for points in vanished:
        shift = np.median(points, axis=0) - here
        if np.linalg.norm(shift) < REACH:
            # Rims overlap: what is newly covered lies ahead of the object, what is laid bare behind it.
            starts += [_shifted(stage.background, shift), _shifted(stage.background, 0.5 * shift)]
    return starts


def _shifted(background: Array, shift: NDArray[np.floating]) -> Array:
    moved = background.copy()
    moved[:3, 3] += shift
    return moved


def _agreeing(matches: Matches, prev_T_curr: Array, camera: Camera) -> Matches:
    error = np.linalg.norm(geometry.transform(prev_T_curr, matches.curr) - matches.prev, axis=1)
    return matches[error < 4 * match_sigma(matches.curr[:, 2], camera)]
