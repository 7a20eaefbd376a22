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
MAX_UNEXPLAINED = 4
"""Regions that nothing explains are reported at most this many times, the largest first."""


class Verdict(NamedTuple):
    """An object that stands: its motion, how sure, and whether it moved."""

    prev_T_curr: Array
    score: float
    moving: bool


class Stage:
    """The two frames at the size where pixels are assigned, with what every round needs of them."""

    def __init__(self, prev: RgbdFrame, curr: RgbdFrame, background: Array, *, min_pixels: int) -> None:
        self.prev, self.curr, self.background, self.min_pixels = prev, curr, background, min_pixels
        self.points = geometry.back_project(curr.depth, curr.camera)
        self.graph = assignment.PixelGraph(curr)
        self.background_cost = assignment.motion_cost(prev, curr, self.points, background)
        self.reach = 0.03 * float(np.median(curr.depth[curr.valid])) + 0.01

    def cost(self, prev_T_curr: Array) -> Floats:
        """(H, W) cost of a motion; see `assignment.motion_cost`."""
        return assignment.motion_cost(self.prev, self.curr, self.points, prev_T_curr)

    def assign(self, motions: list[Array], anchors: list[Floats]) -> NDArray[np.int32]:
        """(H, W) labels: 0 = background, k = the k-th motion, by cost, nearness and the walk along surfaces."""
        costs = [self.background_cost]
        for motion, points in zip(motions, anchors, strict=True):
            near = assignment.nearness_cost(self.points, points, self.reach)
            costs.append(self.cost(motion) + near + 0.1)
        probability = self.graph.walk(np.stack(costs))
        return np.asarray(probability.argmax(0), dtype=np.int32)

    def split(self, labels: NDArray[np.int32]) -> list[Mask]:
        """The separate objects of each label."""
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
    order = sorted(range(len(masks)), key=lambda k: -int(masks[k].sum()))
    for k in order:
        cost = stage.cost(motions[k])
        explained |= masks[k] & (cost < 3)
        gain = float((stage.background_cost - cost)[masks[k]].mean())
        if gain < MIN_GAIN or not _moved(stage, masks[k], motions[k]):
            continue
        fit = float((cost[masks[k]] < 2).mean())
        verdicts.append(Verdict(motions[k], round(fit * (1 - float(np.exp(-2 * gain))), 4), True))
        labels[masks[k] & (labels == 0)] = len(verdicts)
    for region in _unexplained(stage, ~explained & (labels == 0)):
        own = movers[inside(region, movers, target.camera)]
        motion = rigid.fit_matches(own, target.camera)[0] if len(own.curr) >= 6 else stage.background
        fit = float((stage.cost(motion)[region] < 2).mean())
        verdicts.append(Verdict(motion, round(0.25 * fit, 4), True))
        labels[region & (labels == 0)] = len(verdicts)
    return labels, verdicts


def _moved(stage: Stage, mask: Mask, motion: Array) -> bool:
    """Whether an object's displacement against the background exceeds what noise can feign."""
    points = stage.points[mask & ~np.isnan(stage.points[..., 2])]
    shift = np.linalg.norm(geometry.transform(motion, points) - geometry.transform(stage.background, points), axis=1)
    z = float(np.median(points[:, 2]))
    noise = max(0.003, 1.5 * float(depth_sigma(np.array(z))), 0.5 * z / stage.curr.camera.fx)
    return bool(np.median(shift) > noise)


def _unexplained(stage: Stage, doubtful: Mask) -> list[Mask]:
    """Larger regions that cannot have been where any motion puts them."""
    core = cv2.morphologyEx((doubtful & stage.curr.valid).astype(np.uint8), cv2.MORPH_OPEN, np.ones((5, 5)))
    numbers, count = ndimage.label(cv2.dilate(core, np.ones((3, 3))), structure=np.ones((3, 3)))
    sizes = ndimage.sum_labels(np.ones_like(numbers), numbers, range(1, count + 1))
    ranked = np.argsort(-np.asarray(sizes))[:MAX_UNEXPLAINED] + 1
    return [numbers == n for n in ranked if sizes[n - 1] >= 4 * stage.min_pixels]


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
