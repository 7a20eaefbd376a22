"""The pixel stage of `consensus`: labels from motions, and which of them stand as moving objects."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from objectflow import geometry, rigid
from objectflow.consensus import assignment
from objectflow.correspondence import Matches
from objectflow.frame import Camera, RgbdFrame
from objectflow.noise import depth_sigma

Array = NDArray[np.float64]
Floats = NDArray[np.float32]
Mask = NDArray[np.bool_]

MIN_GAIN = 0.35
"""Mean log-likelihood a pixel that an object's motion must win over the background's."""
OBJECT_PRIOR = 0.3
"""Cost of any object's motion over the background's: undecided pixels are background."""
HIDDEN_BY_KNOWN = 0.6
"""Cost of having been hidden behind an object that is known to have been there."""
MIN_TOTAL_GAIN = 100.0
"""And over all its pixels together: what naming one more object costs. Neighbouring pixels are not independent."""
MAX_UNEXPLAINED = 4
"""Regions that nothing explains are reported at most this many times, the largest first."""


class Verdict(NamedTuple):
    """An object that stands: its motion, how sure, and whether it moved."""

    prev_T_curr: Array
    score: float
    moving: bool


class Stage:
    """The two frames at the size where pixels are assigned, with what every round needs of them."""

    def __init__(self, prev: RgbdFrame, curr: RgbdFrame, camera_motion: Array | None, *, min_pixels: int) -> None:
        self.prev, self.curr, self.min_pixels = prev, curr, min_pixels
        self.background = np.eye(4) if camera_motion is None else camera_motion
        self._costs: dict[tuple[bytes, bool], tuple[assignment.Box, Floats]] = {}
        self.points = geometry.back_project(curr.depth, curr.camera)
        self.valid = curr.valid
        self.graph = assignment.PixelGraph(curr)
        self.looks = assignment.Look(prev.color), assignment.Look(curr.color)
        self.background_cost, self.hidden = assignment.motion_cost(prev, self.points, self.background, self.looks)
        self.rival_cost = self.background_cost
        # Before a static camera what was hidden is uncovered by a moving thing; a moving camera uncovers by itself.
        self.telling = ~self.hidden if camera_motion is not None else np.ones_like(self.hidden)
        self.reach = 0.02 * float(np.median(curr.depth[curr.valid])) + 0.01

    def cost(self, prev_T_curr: Array, box: assignment.Box = assignment.EVERYWHERE, *, color: bool = True) -> Floats:
        """(H, W) cost of a motion within a box, ruled out elsewhere; see `assignment.motion_cost`."""
        key = (prev_T_curr.tobytes(), color)
        if key not in self._costs or not _within(box, self._costs[key][0]):
            looks = self.looks if color else None
            cost = np.full(self.valid.shape, assignment.COST_FLOATING, np.float32)
            cost[box] = assignment.motion_cost(self.prev, self.points, prev_T_curr, looks, box)[0]
            self._costs[key] = box, cost
        return self._costs[key][1]

    def around(self, points: Floats) -> assignment.Box:
        """The box of pixels within a few times `reach` of points (N, 3)."""
        pixels = geometry.project(points, self.curr.camera)
        margin = 3.2 * self.reach * self.curr.camera.fx / max(0.1, float(points[:, 2].min()))
        low, high = pixels.min(axis=0) - margin, pixels.max(axis=0) + margin + 1
        height, width = self.valid.shape
        top, bottom = (int(np.clip(value, 0, height)) for value in (low[1], high[1]))
        left, right = (int(np.clip(value, 0, width)) for value in (low[0], high[0]))
        return slice(top, bottom), slice(left, right)

    def assign(
        self, motions: list[Array], anchors: list[Floats], masks: list[Mask], *, fine: bool
    ) -> NDArray[np.int32]:
        """Labels by cost, nearness and the walk along surfaces.

        Args:
            motions: `prev_T_curr` of each object.
            anchors: (N, 3) points that follow each.
            masks: (H, W) of each, as far as known; empty in the first round.
            fine: to the pixel, or in blocks of 2x2.

        Returns:
            (H, W) int32: 0 = background, k = the k-th motion.
        """
        self.rival_cost = self._background_cost_given(motions, masks)
        costs = [self.rival_cost]
        for motion, points in zip(motions, anchors, strict=True):
            near = assignment.nearness_cost(self.points, points, self.reach)
            costs.append(self.cost(motion, self.around(points)) + near + OBJECT_PRIOR)
        probability = self.graph.walk(np.stack(costs), fine=fine)
        return np.asarray(probability.argmax(0), dtype=np.int32)

    def anchors(self, mask: Mask, motion: Array) -> Floats:
        """(N, 3) points of a mask that its motion explains and the background's cannot."""
        cost = self.cost(motion, self.around(self.points[mask & self.valid]))
        decided = mask & self.valid & (self.rival_cost - cost > 1)
        return self.points[decided] if decided.sum() >= 20 else self.points[mask & self.valid]

    def _background_cost_given(self, motions: list[Array], masks: list[Mask]) -> Floats:
        """The background's cost when objects are known: what they hid in `prev` may well be background.

        Then being hidden costs only what the object's colours say: on a dull surface every motion finds the colour
        again and it says nothing, on a textured one a motion that finds it is hardly wrong.
        """
        if not masks:
            return self.background_cost
        height, width = self.valid.shape
        occupied = np.zeros((height, width), np.uint8)
        for motion, mask in zip(motions, masks, strict=True):
            column, row, inside_image = self._pixels_in_prev(motion, self.points[mask & self.valid])
            occupied[row[inside_image], column[inside_image]] = 1
        spread = cv2.dilate(occupied, np.ones((5, 5)))
        column, row, _ = self._pixels_in_prev(self.background, self.points)
        expected = self.hidden & (spread[row, column] > 0)
        texture = np.minimum(self.looks[1].contrast[0] / 25, 1)
        cost = HIDDEN_BY_KNOWN + (assignment.COST_HIDDEN - HIDDEN_BY_KNOWN) * texture
        return np.where(expected, np.minimum(cost, self.background_cost), self.background_cost).astype(np.float32)

    def _pixels_in_prev(self, motion: Array, points: Floats) -> tuple[NDArray[np.intp], NDArray[np.intp], Mask]:
        pixels = np.nan_to_num(geometry.project(geometry.transform(motion, points), self.prev.camera), nan=-9)
        height, width = self.valid.shape
        column, row = np.rint(pixels[..., 0]).astype(int), np.rint(pixels[..., 1]).astype(int)
        inside_image = (column >= 0) & (row >= 0) & (column < width) & (row < height)
        return np.clip(column, 0, width - 1), np.clip(row, 0, height - 1), inside_image

    def split(self, labels: NDArray[np.int32]) -> list[tuple[int, Mask]]:
        """The separate objects of each label; see `assignment.split_regions`."""
        return assignment.split_regions(
            labels, self.points, self.graph, min_pixels=self.min_pixels, gap=max(0.03, self.reach)
        )


def settle(
    stage: Stage, masks: list[Mask], motions: list[Array], target: rigid.Target, movers: Matches
) -> tuple[NDArray[np.int32], list[Verdict]]:
    """Decide what is reported.

    Args:
        stage: frames and background.
        masks: of the objects, on the stage's pixels.
        motions: `prev_T_curr` of each.
        target: the previous frame for `rigid`.
        movers: matches that do not follow the background.

    Returns:
        (H, W) int32 labels on the stage's pixels, and a verdict for each label from 1.
    """
    labels = np.zeros(stage.curr.depth.shape, np.int32)
    verdicts: list[Verdict] = []
    explained = stage.background_cost < 3
    for k in sorted(range(len(masks)), key=lambda k: -int(masks[k].sum())):
        cost = stage.cost(motions[k], stage.around(stage.points[masks[k] & stage.valid]))
        explained |= masks[k] & (cost < 3)
        gains = ((stage.background_cost - cost) * stage.telling)[masks[k]]
        if gains.mean() < MIN_GAIN or gains.sum() < MIN_TOTAL_GAIN or not _moved(stage, masks[k], motions[k]):
            continue
        host = _host(stage, masks[k], motions[k], labels, verdicts)
        if host is not None:
            labels[masks[k] & (labels == 0)] = host
            continue
        fit = float((cost[masks[k]] < 2).mean())
        verdicts.append(Verdict(motions[k], round(fit * (1 - float(np.exp(-2 * gains.mean()))), 4), True))
        labels[masks[k] & (labels == 0)] = len(verdicts)
    for region in _unexplained(stage, ~explained & (labels == 0)):
        own = movers[inside(region, movers, target.camera)]
        motion = rigid.fit_matches(own, target.camera)[0] if len(own.curr) >= 6 else stage.background
        box = stage.around(stage.points[region & stage.valid])
        fit = float((stage.cost(motion, box)[region] < 2).mean())
        verdicts.append(Verdict(motion, round(0.25 * fit, 4), True))
        labels[region & (labels == 0)] = len(verdicts)
    return labels, verdicts


def prune(stage: Stage, masks: list[Mask], motions: list[Array]) -> list[int]:
    """Which objects are worth naming: those that explain their pixels better than all the others and the background.

    Args:
        stage: frames and background.
        masks: of the objects.
        motions: `prev_T_curr` of each.

    Returns:
        Indices to keep, in their order.
    """
    boxes = [stage.around(stage.points[mask & stage.valid]) for mask in masks]
    costs = [stage.cost(motion, box) for motion, box in zip(motions, boxes, strict=True)]
    keep = list(range(len(masks)))
    # Weakest first, so that of two alike the weaker one goes and the other stays.
    for k in sorted(keep, key=lambda k: int(masks[k].sum())):
        others = [costs[j] for j in keep if j != k]
        rival = np.minimum.reduce([stage.background_cost, *others])
        gains = ((rival - costs[k]) * stage.telling)[masks[k]]
        if gains.mean() < MIN_GAIN or gains.sum() < MIN_TOTAL_GAIN:
            keep.remove(k)
    return keep


def _host(stage: Stage, mask: Mask, motion: Array, labels: NDArray[np.int32], verdicts: list[Verdict]) -> int | None:
    """The larger neighbour whose motion explains a small piece's depth as well as its own does, if there is one.

    Colour is left out here: where depth and colour are not registered to the pixel, an object's rim carries the
    colour of what lies behind it, and some odd motion always finds that colour again.
    """
    around = labels[(cv2.dilate(mask.astype(np.uint8), np.ones((5, 5))) > 0) & ~mask]
    box = stage.around(stage.points[mask & stage.valid])
    best = float(stage.cost(motion, box, color=False)[mask].mean()) + 0.3
    host = None
    for number in np.unique(around[around > 0]):
        if mask.sum() > 0.5 * (labels == number).sum():
            continue
        theirs = float(stage.cost(verdicts[number - 1].prev_T_curr, box, color=False)[mask].mean())
        if theirs < best:
            best, host = theirs, int(number)
    return host


def _moved(stage: Stage, mask: Mask, motion: Array) -> bool:
    """Whether an object's displacement against the background exceeds what noise and calibration can feign."""
    points = stage.points[mask & stage.valid]
    there = geometry.transform(stage.background, points)
    shift = np.linalg.norm(geometry.transform(motion, points) - there, axis=1)
    z = float(np.median(points[:, 2]))
    noise = max(0.003, 1.5 * float(depth_sigma(np.array(z))), 0.5 * z / stage.curr.camera.fx)
    # Depth cameras are a few percent off in scale; what the camera's own motion makes of that is no object's motion.
    noise += 0.1 * float(np.median(np.linalg.norm(there - points, axis=1)))
    return bool(np.median(shift) > noise)


def _unexplained(stage: Stage, doubtful: Mask) -> list[Mask]:
    """Larger regions that cannot have been where any motion puts them."""
    core = cv2.morphologyEx((doubtful & stage.curr.valid).astype(np.uint8), cv2.MORPH_OPEN, np.ones((5, 5)))
    numbers, count = ndimage.label(cv2.dilate(core, np.ones((3, 3))), structure=np.ones((3, 3)))
    sizes = np.bincount(numbers.ravel(), minlength=count + 1)[1:]
    ranked = np.argsort(-sizes)[:MAX_UNEXPLAINED]
    return [numbers == n + 1 for n in ranked if sizes[n] >= 4 * stage.min_pixels]


def _within(box: assignment.Box, other: assignment.Box) -> bool:
    """Whether a box lies inside another."""
    if other == assignment.EVERYWHERE:
        return True
    if box == assignment.EVERYWHERE:
        return False
    return all(o.start <= b.start and b.stop <= o.stop for b, o in zip(box, other, strict=True))


def inside(mask: Mask, matches: Matches, camera: Camera) -> Mask:
    """(N,) bool: matches whose pixel, given on `camera`'s image, lies in a mask of any size."""
    height, width = mask.shape
    column = np.clip((matches.pixels[:, 0] + 0.5) * width / camera.width, 0, width - 1).astype(int)
    row = np.clip((matches.pixels[:, 1] + 0.5) * height / camera.height, 0, height - 1).astype(int)
    return np.asarray(mask[row, column])


def enlarge(mask: Mask, frame: RgbdFrame) -> Mask:
    """A mask brought to a frame's size by its nearest pixels."""
    size = (frame.camera.width, frame.camera.height)
    return np.asarray(cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0)
