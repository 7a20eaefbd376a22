"""Model selection: which masks are reported as moving objects, and which regions no motion explains."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from objectflow import geometry
from objectflow.alignment import fitting
from objectflow.alignment.fitting import FitSettings
from objectflow.alignment.likelihood import EXPLAINED_COST, motion_confidence
from objectflow.alignment.matching import PixelMatches, inside
from objectflow.geometry.camera import Camera
from objectflow.geometry.moved import is_moving
from objectflow.methods.consensus.assignment import Assignment
from objectflow.settings import Settings, setting
from objectflow.typing import BoolMask, Float64Array, LabelImage


@dataclass(frozen=True)
class SelectionSettings(Settings):
    """What an object's motion must explain, in nats, to be reported."""

    min_gain: float = setting(0.35, minimum=0)
    """Minimum mean log-likelihood per pixel that an object's motion gains over the background's."""
    min_total_gain: float = setting(100.0, minimum=0)
    """Minimum sum over the object's pixels: the cost of one more object. Neighbouring pixels are not independent."""
    shadow_hue: float = setting(0.02, minimum=0)
    """Largest median change of the share of red, green or blue under which a region may be a shadow."""
    shadow_spread: float = setting(0.35, minimum=0)
    """Largest standard deviation of the logarithm of the change of brightness under which it may be one."""
    max_host_loss: float = setting(0.3, minimum=0)
    """Largest mean depth cost that a small piece may lose by taking a larger neighbour's motion."""
    max_host_share: float = setting(0.5, minimum=0)
    """Largest size of such a piece relative to that neighbour."""
    static_displacement: float = setting(0.003, minimum=0)
    """Metres: smallest displacement against the background that counts as motion."""
    static_sigmas: float = setting(1.5, minimum=0)
    """The same in standard deviations of depth."""
    static_pixels: float = setting(0.5, minimum=0)
    """The same in pixels."""
    scale_error: float = setting(0.1, minimum=0)
    """Error of the camera's motion relative to its length: depth cameras are off in scale by a few percent."""
    explained_cost: float = setting(3.0, above=0)
    """Largest cost of a pixel that the background or a selected motion explains."""
    unexplained_score: float = setting(0.25, minimum=0, maximum=1)
    """Factor on the score of regions that changed without a motion of their own: their motion is a guess."""
    max_unexplained: int = setting(4, minimum=0)
    """Maximum number of reported regions that no motion explains, the largest first."""


class Selection(NamedTuple):
    """A reported object: its motion, the confidence in it, and whether it moved."""

    prev_T_curr: Float64Array
    score: float
    moving: bool


def select_objects(
    assignment: Assignment,
    masks: list[BoolMask],
    motions: list[Float64Array],
    camera: Camera,
    movers: PixelMatches,
    settings: SelectionSettings,
    *,
    fit: FitSettings,
) -> tuple[LabelImage, list[Selection]]:
    """Decide what is reported.

    Args:
        assignment: frames and background.
        masks: of the objects, at the size of the assignment.
        motions: `prev_T_curr` of each.
        camera: to which the pixels of `movers` refer.
        movers: matches that do not follow the background.
        settings: see there.
        fit: how a motion is fitted to the matches of a region that no motion explains.

    Returns:
        (H, W) int32 labels at the size of the assignment, and a selection for each label from 1.
    """
    labels = np.zeros(assignment.valid.shape, np.int32)
    selections: list[Selection] = []
    explained = assignment.background_cost < settings.explained_cost
    for k in sorted(range(len(masks)), key=lambda k: -int(masks[k].sum())):
        mask, motion = masks[k], motions[k]
        cost = assignment.cost(motion, assignment.around_mask(mask))
        explained |= mask & (cost < settings.explained_cost)
        gains = ((assignment.background_cost - cost) * assignment.informative)[mask]
        if not _is_worth(gains, settings) or not _has_moved(assignment, mask, motion, settings):
            continue
        flat = _depth_gain(assignment, mask, motion) < settings.min_gain
        if flat and (assignment.camera_moved or _is_shadow(assignment, mask, settings)):
            continue
        host = _host(assignment, mask, motion, labels, selections, settings)
        if host is not None:
            labels[mask & (labels == 0)] = host
            continue
        selections.append(Selection(motion, motion_confidence(cost[mask], gains), True))
        labels[mask & (labels == 0)] = len(selections)
    for region in _unexplained(assignment, ~explained & (labels == 0), settings):
        own = movers[inside(region, movers, camera)]
        motion = assignment.background
        if len(own.curr) >= 6:
            motion = fitting.fit_matches(own, camera, noise=assignment.pair.noise, settings=fit)[0]
        share = float((assignment.cost(motion, assignment.around_mask(region))[region] < EXPLAINED_COST).mean())
        selections.append(Selection(motion, round(settings.unexplained_score * share, 4), True))
        labels[region & (labels == 0)] = len(selections)
    return labels, selections


def prune(
    assignment: Assignment, masks: list[BoolMask], motions: list[Float64Array], settings: SelectionSettings
) -> list[int]:
    """Indices of the objects that explain their pixels better than the background and all other objects, in order."""
    boxes = [assignment.around_mask(mask) for mask in masks]
    costs = [assignment.cost(motion, box) for motion, box in zip(motions, boxes, strict=True)]
    keep = list(range(len(masks)))
    # The weakest first, so that of two equal objects the weaker one is removed.
    for k in sorted(keep, key=lambda k: int(masks[k].sum())):
        others = [costs[j] for j in keep if j != k]
        rival = np.minimum.reduce([assignment.background_cost, *others])
        if not _is_worth(((rival - costs[k]) * assignment.informative)[masks[k]], settings):
            keep.remove(k)
    return keep


def _is_worth(gains: NDArray[np.floating[Any]], settings: SelectionSettings) -> bool:
    """Whether the gains of an object's pixels pay for one more object."""
    return bool(gains.mean() >= settings.min_gain and gains.sum() >= settings.min_total_gain)


def _depth_gain(assignment: Assignment, mask: BoolMask, motion: Float64Array) -> float:
    """Mean gain of a motion over the background's by depth alone.

    Before a moving camera, colour that is not exactly registered to depth slides over every depth edge.
    """
    static = assignment.cost(assignment.background, color=False)
    moved = assignment.cost(motion, assignment.around_mask(mask), color=False)
    return float(((static - moved) * assignment.informative)[mask].mean())


def _is_shadow(assignment: Assignment, mask: BoolMask, settings: SelectionSettings) -> bool:
    """Whether a region only became darker or lighter against the background: a shadow keeps hue and texture."""
    column, row, _ = assignment.pixels_in_prev(assignment.background, assignment.points)
    changed = mask & assignment.valid & (assignment.background_cost > 1)
    if not changed.any():
        return True
    prev_color, curr_color = assignment.pair.prev.frame.color, assignment.pair.curr.frame.color
    before = prev_color[row[changed], column[changed]].astype(np.float64) + 4
    after = curr_color[changed].astype(np.float64) + 4
    hue = np.abs(before / before.sum(axis=1, keepdims=True) - after / after.sum(axis=1, keepdims=True)).max(axis=1)
    dimming = np.log(after.sum(axis=1) / before.sum(axis=1))
    return bool(np.median(hue) < settings.shadow_hue and np.std(dimming) < settings.shadow_spread)


def _host(
    assignment: Assignment,
    mask: BoolMask,
    motion: Float64Array,
    labels: LabelImage,
    selections: list[Selection],
    settings: SelectionSettings,
) -> int | None:
    """The larger neighbour whose motion explains a small piece's depth about as well as its own, or None.

    Colour is left out: where depth and colour are not registered to the pixel, the rim of an object has the colour of
    what lies behind it, and some motion always finds that colour again.
    """
    around = labels[(cv2.dilate(mask.astype(np.uint8), np.ones((5, 5))) > 0) & ~mask]
    box = assignment.around_mask(mask)
    best = float(assignment.cost(motion, box, color=False)[mask].mean()) + settings.max_host_loss
    host = None
    for number in np.unique(around[around > 0]):
        if mask.sum() > settings.max_host_share * (labels == number).sum():
            continue
        theirs = float(assignment.cost(selections[number - 1].prev_T_curr, box, color=False)[mask].mean())
        if theirs < best:
            best, host = theirs, int(number)
    return host


def _has_moved(assignment: Assignment, mask: BoolMask, motion: Float64Array, settings: SelectionSettings) -> bool:
    """Whether an object's motion against the background exceeds noise and calibration errors."""
    points = assignment.points[mask & assignment.valid].astype(np.float64)
    center = points.mean(axis=0)
    static = geometry.transform(assignment.background, center)
    z, camera = float(np.median(points[:, 2])), assignment.pair.curr.frame.camera
    tolerance = max(
        settings.static_displacement,
        settings.static_sigmas * float(assignment.pair.noise.sigma(z)),
        settings.static_pixels * z / camera.fx,
    )
    tolerance += settings.scale_error * float(np.linalg.norm(static - center))
    own = geometry.inverse(assignment.background) @ motion
    translation = geometry.transform(own, center) - center
    lever_arm = float(np.median(np.linalg.norm(points - center, axis=1)))
    return bool(is_moving(own[:3, :3], translation, tolerance, lever_arm=lever_arm))


def _unexplained(assignment: Assignment, doubtful: BoolMask, settings: SelectionSettings) -> list[BoolMask]:
    """Larger regions that no motion explains."""
    core = cv2.morphologyEx((doubtful & assignment.valid).astype(np.uint8), cv2.MORPH_OPEN, np.ones((5, 5)))
    numbers, count = ndimage.label(cv2.dilate(core, np.ones((3, 3))), structure=np.ones((3, 3)))
    sizes = np.bincount(numbers.ravel(), minlength=count + 1)[1:]
    ranked = np.argsort(-sizes)[: settings.max_unexplained]
    return [numbers == n + 1 for n in ranked if sizes[n] >= 4 * assignment.min_pixels]
