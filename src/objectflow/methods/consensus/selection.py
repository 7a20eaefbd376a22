"""Which labels stand as moving objects, and what no motion explains."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from scipy import ndimage

from objectflow import geometry
from objectflow.alignment import fitting, registration
from objectflow.alignment.likelihood import motion_confidence
from objectflow.alignment.matching import PixelMatches, inside
from objectflow.geometry.depth_noise import depth_sigma
from objectflow.methods.consensus.assignment import Assignment
from objectflow.typing import BoolMask, Float64Array, LabelImage

MIN_GAIN = 0.35
"""Mean log-likelihood a pixel that an object's motion must win over the background's."""
SHADOW_HUE, SHADOW_SPREAD = 0.02, 0.35
"""A shadow changes the share of red, green or blue by less, and the logarithm of brightness as evenly as this."""
MIN_TOTAL_GAIN = 100.0
"""And over all its pixels together: what naming one more object costs. Neighbouring pixels are not independent."""
MAX_UNEXPLAINED = 4
"""Regions that nothing explains are reported at most this many times, the largest first."""


class Selection(NamedTuple):
    """An object that stands: its motion, how sure, and whether it moved."""

    prev_T_curr: Float64Array
    score: float
    moving: bool


def select_objects(
    assignment: Assignment,
    masks: list[BoolMask],
    motions: list[Float64Array],
    target: registration.RegistrationTarget,
    movers: PixelMatches,
) -> tuple[LabelImage, list[Selection]]:
    """Decide what is reported.

    Args:
        assignment: frames and background.
        masks: of the objects, on the assignment size pixels.
        motions: `prev_T_curr` of each.
        target: the previous frame for `rigid`.
        movers: matches that do not follow the background.

    Returns:
        (H, W) int32 labels on the assignment size pixels, and a verdict for each label from 1.
    """
    labels = np.zeros(assignment.curr.depth.shape, np.int32)
    verdicts: list[Selection] = []
    explained = assignment.background_cost < 3
    for k in sorted(range(len(masks)), key=lambda k: -int(masks[k].sum())):
        cost = assignment.cost(motions[k], assignment.around(assignment.points[masks[k] & assignment.valid]))
        explained |= masks[k] & (cost < 3)
        gains = ((assignment.background_cost - cost) * assignment.telling)[masks[k]]
        if gains.mean() < MIN_GAIN or gains.sum() < MIN_TOTAL_GAIN or not _moved(assignment, masks[k], motions[k]):
            continue
        flat = _depth_gain(assignment, masks[k], motions[k]) < MIN_GAIN
        if flat and (assignment.camera_moved or _is_shadow(assignment, masks[k])):
            continue
        host = _host(assignment, masks[k], motions[k], labels, verdicts)
        if host is not None:
            labels[masks[k] & (labels == 0)] = host
            continue
        verdicts.append(Selection(motions[k], motion_confidence(cost[masks[k]], gains), True))
        labels[masks[k] & (labels == 0)] = len(verdicts)
    for region in _unexplained(assignment, ~explained & (labels == 0)):
        own = movers[inside(region, movers, target.camera)]
        motion = fitting.fit_matches(own, target.camera)[0] if len(own.curr) >= 6 else assignment.background
        box = assignment.around(assignment.points[region & assignment.valid])
        fit = float((assignment.cost(motion, box)[region] < 2).mean())
        verdicts.append(Selection(motion, round(0.25 * fit, 4), True))
        labels[region & (labels == 0)] = len(verdicts)
    return labels, verdicts


def _depth_gain(assignment: Assignment, mask: BoolMask, motion: Float64Array) -> float:
    """What a motion wins over the background's by depth alone, a pixel.

    Where the camera moves, colour that is not registered to depth slides over every depth edge; depth does not.
    """
    box = assignment.around(assignment.points[mask & assignment.valid])
    still = assignment.cost(assignment.background, color=False)
    return float(((still - assignment.cost(motion, box, color=False)) * assignment.telling)[mask].mean())


def _is_shadow(assignment: Assignment, mask: BoolMask) -> bool:
    """Whether a region only got darker or lighter against the background: a shadow's own hue and print stay."""
    column, row, _ = assignment.pixels_in_prev(assignment.background, assignment.points)
    changed = mask & assignment.valid & (assignment.background_cost > 1)
    if not changed.any():
        return True
    before = assignment.prev.color[row[changed], column[changed]].astype(np.float64) + 4
    after = assignment.curr.color[changed].astype(np.float64) + 4
    hue = np.abs(before / before.sum(axis=1, keepdims=True) - after / after.sum(axis=1, keepdims=True)).max(axis=1)
    dimming = np.log(after.sum(axis=1) / before.sum(axis=1))
    return bool(np.median(hue) < SHADOW_HUE and np.std(dimming) < SHADOW_SPREAD)


def prune(assignment: Assignment, masks: list[BoolMask], motions: list[Float64Array]) -> list[int]:
    """Which objects are worth naming: those that explain their pixels better than all the others and the background.

    Args:
        assignment: frames and background.
        masks: of the objects.
        motions: `prev_T_curr` of each.

    Returns:
        Indices to keep, in their order.
    """
    boxes = [assignment.around(assignment.points[mask & assignment.valid]) for mask in masks]
    costs = [assignment.cost(motion, box) for motion, box in zip(motions, boxes, strict=True)]
    keep = list(range(len(masks)))
    # Weakest first, so that of two alike the weaker one goes and the other stays.
    for k in sorted(keep, key=lambda k: int(masks[k].sum())):
        others = [costs[j] for j in keep if j != k]
        rival = np.minimum.reduce([assignment.background_cost, *others])
        gains = ((rival - costs[k]) * assignment.telling)[masks[k]]
        if gains.mean() < MIN_GAIN or gains.sum() < MIN_TOTAL_GAIN:
            keep.remove(k)
    return keep


def _host(
    assignment: Assignment, mask: BoolMask, motion: Float64Array, labels: LabelImage, verdicts: list[Selection]
) -> int | None:
    """The larger neighbour whose motion explains a small piece's depth as well as its own does, if there is one.

    Colour is left out here: where depth and colour are not registered to the pixel, an object's rim carries the
    colour of what lies behind it, and some odd motion always finds that colour again.
    """
    around = labels[(cv2.dilate(mask.astype(np.uint8), np.ones((5, 5))) > 0) & ~mask]
    box = assignment.around(assignment.points[mask & assignment.valid])
    best = float(assignment.cost(motion, box, color=False)[mask].mean()) + 0.3
    host = None
    for number in np.unique(around[around > 0]):
        if mask.sum() > 0.5 * (labels == number).sum():
            continue
        theirs = float(assignment.cost(verdicts[number - 1].prev_T_curr, box, color=False)[mask].mean())
        if theirs < best:
            best, host = theirs, int(number)
    return host


def _moved(assignment: Assignment, mask: BoolMask, motion: Float64Array) -> bool:
    """Whether an object's displacement against the background exceeds what noise and calibration can feign."""
    points = assignment.points[mask & assignment.valid]
    there = geometry.transform(assignment.background, points)
    shift = np.linalg.norm(geometry.transform(motion, points) - there, axis=1)
    z = float(np.median(points[:, 2]))
    noise = max(0.003, 1.5 * float(depth_sigma(np.array(z))), 0.5 * z / assignment.curr.camera.fx)
    # Depth cameras are a few percent off in scale; what the camera's own motion makes of that is no object's motion.
    noise += 0.1 * float(np.median(np.linalg.norm(there - points, axis=1)))
    return bool(np.median(shift) > noise)


def _unexplained(assignment: Assignment, doubtful: BoolMask) -> list[BoolMask]:
    """Larger regions that cannot have been where any motion puts them."""
    core = cv2.morphologyEx((doubtful & assignment.curr.valid).astype(np.uint8), cv2.MORPH_OPEN, np.ones((5, 5)))
    numbers, count = ndimage.label(cv2.dilate(core, np.ones((3, 3))), structure=np.ones((3, 3)))
    sizes = np.bincount(numbers.ravel(), minlength=count + 1)[1:]
    ranked = np.argsort(-sizes)[:MAX_UNEXPLAINED]
    return [numbers == n + 1 for n in ranked if sizes[n] >= 4 * assignment.min_pixels]
