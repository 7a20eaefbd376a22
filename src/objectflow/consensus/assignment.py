"""Which pixel follows which motion: a cost for every pixel and motion, then a random walk that stops at edges."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse import csgraph
from scipy.sparse.linalg import splu
from scipy.spatial import cKDTree

from objectflow import geometry, rigid
from objectflow.frame import RgbdFrame
from objectflow.noise import depth_sigma

Array = NDArray[np.float64]
Floats = NDArray[np.float32]

Box = tuple[slice, slice]
EVERYWHERE: Box = (slice(None), slice(None))

COST_FLOATING = 6.0
"""The point would hang in front of what the previous frame saw there: it was not there."""
COST_HIDDEN = 2.0
"""The point would have been hidden: possible, but a motion that shows it is better."""
COST_UNSEEN = 1.0
"""Outside the previous image, or no depth there: says nothing for or against."""

_BOND = 30.0
"""Strength of the tie between two pixels of one smooth, evenly coloured surface, against 1 for a certain pixel."""


class Look:
    """A frame's colour, taken apart so that shadows count little: they travel with what casts them.

    Attributes:
        channels: texture (lightness less its local mean), lightness, and two colour-opponent channels (CIELAB).
        contrast: of each channel around each pixel.
    """

    TOLERANCES = ((8.0, 0.35), (40.0, 0.35), (8.0, 0.35), (8.0, 0.35))
    """For each channel: grey levels that cost 0.5, and how much of the local contrast comes on top."""

    def __init__(self, color: NDArray[np.uint8]) -> None:
        lab = cv2.cvtColor(color, cv2.COLOR_RGB2LAB).astype(np.float32)
        light = np.ascontiguousarray(lab[..., 0])
        texture = light - cv2.GaussianBlur(light, (0, 0), 4)
        self.channels = (texture, light, *(np.ascontiguousarray(lab[..., k]) for k in (1, 2)))
        size = np.ones((3, 3))
        self.contrast = tuple(cv2.dilate(channel, size) - cv2.erode(channel, size) for channel in self.channels)


def motion_cost(
    prev: RgbdFrame, points: Floats, prev_T_curr: Array, looks: tuple[Look, Look] | None, box: Box = EVERYWHERE
) -> tuple[Floats, NDArray[np.bool_]]:
    """How badly a motion fits each pixel, as a negative log-likelihood.

    Args:
        prev: the previous frame.
        points: (H, W, 3) of the current frame, at the same size.
        prev_T_curr: the motion.
        looks: of the previous and the current frame; None leaves colour out.
        box: rows and columns of the current frame to look at.

    Returns:
        Both of the box' size. (h, w) float32; 0 is perfect, `COST_FLOATING` is ruled out; pixels without depth get
        `COST_UNSEEN`.
        (h, w) bool: the pixel would have been hidden behind something.
    """
    camera = prev.camera
    carried = geometry.transform(prev_T_curr, points[box])
    pixels = geometry.project(carried, camera)
    z = carried[..., 2]
    sigma = 1.4 * depth_sigma(np.nan_to_num(z, nan=1.0)) + 0.001
    with np.errstate(invalid="ignore"):
        inside = (
            (pixels[..., 0] > 0)
            & (pixels[..., 1] > 0)
            & (pixels[..., 0] < camera.width - 1)
            & (pixels[..., 1] < camera.height - 1)
        )
    u, v = np.where(inside, pixels[..., 0], 0), np.where(inside, pixels[..., 1], 0)
    u0, v0 = u.astype(np.int32), v.astype(np.int32)
    offset = np.full(z.shape, np.inf, np.float32)
    # The best of the four neighbours: at a depth edge a mean of two surfaces would fit neither.
    for du, dv in ((0, 0), (1, 0), (0, 1), (1, 1)):
        seen = prev.depth[np.minimum(v0 + dv, camera.height - 1), np.minimum(u0 + du, camera.width - 1)]
        candidate = np.where(seen > 0, z - seen, np.inf)
        offset = np.where(np.abs(candidate) < np.abs(offset), candidate, offset)
    known = inside & np.isfinite(offset) & np.isfinite(z)
    scaled = np.where(known, offset, 0) / sigma
    cost = 0.5 * np.minimum(scaled**2, 9)
    if looks is not None:
        cost = cost + _color_cost(*looks, u.astype(np.float32), v.astype(np.float32), box)
    cost = np.where(scaled < -3, COST_FLOATING, np.where(scaled > 3, COST_HIDDEN + 1.0 * (scaled < 6), cost))
    cost = np.where(known, np.minimum(cost, COST_FLOATING), COST_UNSEEN).astype(np.float32)
    return cost, known & (scaled > 3)


def _color_cost(prev: Look, curr: Look, u: Floats, v: Floats, box: Box) -> Floats:
    """Up to 2: the look at (u, v) in `prev` against the box' own; edges may be off by half a pixel."""
    cost = np.zeros(u.shape, np.float32)
    for channel, (tolerance, slack) in enumerate(Look.TOLERANCES):
        warped = cv2.remap(prev.channels[channel], u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        own, contrast = curr.channels[channel][box], curr.contrast[channel][box]
        cost += ((warped - own) / (tolerance + slack * contrast)) ** 2
    return np.asarray(np.minimum(0.5 * cost, 2), dtype=np.float32)


def nearness_cost(points: Floats, anchors: Floats, reach: float) -> Floats:
    """Up to 4: distance of each pixel's point from the nearest point that is known to follow the motion.

    Args:
        points: (H, W, 3) metres.
        anchors: (N, 3) metres.
        reach: metres that cost nothing; twice as far costs 1.
    """
    height, width = points.shape[:2]
    # Distance is smooth: a third of the pixels each way, and the rest between them, at a ninth of the time.
    coarse = np.nan_to_num(points[1::3, 1::3], nan=1e3)
    thinned = anchors[:: max(1, len(anchors) // 500)]
    distance, _ = cKDTree(thinned).query(coarse.reshape(-1, 3), distance_upper_bound=4 * reach)
    far = np.clip(distance / reach - 1, 0, 2).reshape(coarse.shape[:2]) ** 2
    return np.asarray(cv2.resize(far.astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR))


class PixelGraph:
    """The ties between neighbouring pixels of the current frame: weak across depth steps, creases and colour edges."""

    def __init__(self, frame: RgbdFrame) -> None:
        depth = frame.depth
        self.shape = depth.shape
        index = np.arange(depth.size).reshape(depth.shape)
        points = geometry.back_project(depth, frame.camera)
        normals = rigid.surface_normals(cv2.medianBlur(depth, 5), frame.camera)
        color = cv2.GaussianBlur(frame.color, (0, 0), 0.7).astype(np.float32)
        heads, tails, ties, steps = [], [], [], []
        for here, there in (
            ((slice(None), slice(None, -1)), (slice(None), slice(1, None))),
            ((slice(None, -1), slice(None)), (slice(1, None), slice(None))),
        ):
            tie, step = self._tie(depth, points, normals, color, here, there)
            heads.append(index[here].ravel())
            tails.append(index[there].ravel())
            ties.append(tie.ravel())
            steps.append(step.ravel())
        self.head, self.tail = np.concatenate(heads), np.concatenate(tails)
        self.tie, self.step = np.concatenate(ties), np.concatenate(steps)
        n = depth.size
        half = sparse.coo_array((self.tie, (self.head, self.tail)), shape=(n, n)).tocsr()
        weights = half + half.T
        self.laplacian: sparse.csr_array = (
            sparse.diags_array(np.asarray(weights.sum(axis=1)).ravel()) - weights
        ).tocsr()
        self.blocks = _blocks(depth.shape)
        self.coarse_laplacian = (self.blocks.T @ self.laplacian @ self.blocks).tocsc()

    @staticmethod
    def _tie(
        depth: Floats, points: Floats, normals: Floats, color: Floats, here: Any, there: Any
    ) -> tuple[Array, NDArray[np.bool_]]:
        z0, z1 = depth[here], depth[there]
        both = (z0 > 0) & (z1 > 0)
        gap = np.abs(z0 - z1)
        # A surface seen at 75 degrees steps by about 1.5% of its depth a pixel at 320 wide.
        allowed = 0.008 * np.maximum(z0, z1) + 3 * depth_sigma(np.maximum(z0, z1))
        step = both & (gap > allowed)
        with np.errstate(invalid="ignore"):
            turn = ((normals[there] - normals[here]) * (points[there] - points[here])).sum(-1)
            crease = (turn < 0) & ((normals[there] * normals[here]).sum(-1) < 0.97)
        change = np.abs(color[here] - color[there]).max(-1)
        # A colour edge alone never cuts through: it may be print. Depth steps and creases do.
        tie = _BOND * (0.12 + 0.88 * np.exp(-((change / 25) ** 2))) * np.exp(-((gap / allowed) ** 2)) + 0.02
        tie = np.where(crease, 0.15 * tie, tie)
        tie = np.where(both, tie, 0.05 * _BOND * np.exp(-((change / 15) ** 2)) + 0.02)
        return np.where(step, 0.01, tie), step

    def walk(self, costs: Floats, *, fine: bool = True) -> Floats:
        """Random walker with priors (Grady, CVPR 2005): the share of walks from a pixel that end in each motion.

        Args:
            costs: (K, H, W) negative log-likelihoods.
            fine: to the pixel; else 2x2 blocks share one answer, in half the time.

        Returns:
            (K, H, W) probabilities. A pixel pulls by how decided it is, so undecided ones follow their surface.
        """
        likelihood = np.exp(-(costs - costs.min(0)))
        prior = (likelihood / likelihood.sum(0)).reshape(len(costs), -1).astype(np.float64)
        top = np.partition(prior, -2, axis=0)[-2:] if len(costs) > 1 else np.stack([prior[0] * 0, prior[0]])
        pull = (top[1] - top[0]) + 1e-3
        walked = self._two_grid(pull, (prior * pull).T, cycles=2 if fine else 0)
        return np.asarray(walked.T.reshape(costs.shape), dtype=np.float32)

    def _two_grid(self, pull: Array, right: Array, *, cycles: int) -> Array:
        """Solve the walk on 2x2 blocks exactly, on pixels by smoothing, twice: a fifth of the time of a full solve.

        A textbook two-grid cycle with Galerkin's coarse system and damped Jacobi; labels are an argmax, so the last
        digits do not matter.
        """
        coarse = splu(
            self.coarse_laplacian + sparse.diags_array(self.blocks.T @ pull).tocsc(),
            permc_spec="MMD_AT_PLUS_A",
            diag_pivot_thresh=0.0,
            options={"SymmetricMode": True},
        )
        anchor = pull[:, None]
        step = (0.8 / (self.laplacian.diagonal() + pull))[:, None]
        solution = self.blocks @ coarse.solve(self.blocks.T @ right)
        for cycle in range(cycles):
            for _ in range(4):
                solution += step * (right - self.laplacian @ solution - anchor * solution)
            if cycle + 1 < cycles:
                residual = right - self.laplacian @ solution - anchor * solution
                solution += self.blocks @ coarse.solve(self.blocks.T @ residual)
        return np.asarray(solution)

    def components(self, labels: NDArray[np.int32]) -> NDArray[np.int32]:
        """(H, W) component numbers: pixels of one label, joined where no depth step divides them."""
        flat = labels.ravel()
        joined = (flat[self.head] == flat[self.tail]) & ~self.step
        n = flat.size
        graph = sparse.coo_array(
            (np.ones(joined.sum(), np.int8), (self.head[joined], self.tail[joined])), shape=(n, n)
        )
        _, numbers = csgraph.connected_components(graph, directed=False)
        return np.asarray(numbers.reshape(self.shape), dtype=np.int32)


def _blocks(shape: tuple[int, int]) -> sparse.csr_array:
    """(H W, h w) 0/1 matrix: which 2x2 block a pixel lies in."""
    height, width = shape
    row, column = np.mgrid[0:height, 0:width] // 2
    block = (row * ((width + 1) // 2) + column).ravel()
    ones = np.ones(height * width)
    return sparse.csr_array((ones, (np.arange(height * width), block)))


def split_regions(
    labels: NDArray[np.int32], points: Floats, graph: PixelGraph, *, min_pixels: int, gap: float
) -> list[tuple[int, NDArray[np.bool_]]]:
    """Masks of the separate pieces of each label; pieces closer than `gap` metres stay one object.

    Args:
        labels: (H, W), 0 = background.
        points: (H, W, 3) metres.
        graph: of the same frame.
        min_pixels: smaller objects are dropped, and pieces under a quarter of it do not join others.
        gap: metres between pieces that may be one object behind an obstacle, or a mask with a crack.

    Returns:
        (label, mask) of each, in order of labels.
    """
    labels = np.where(np.isnan(points[..., 2]), 0, labels).astype(np.int32)
    pieces = graph.components(labels)
    sizes = np.bincount(pieces.ravel())
    label_of = np.zeros(len(sizes), np.int32)
    label_of[pieces.ravel()] = labels.ravel()
    found: list[tuple[int, NDArray[np.bool_]]] = []
    for label in np.unique(labels[labels > 0]):
        numbers = np.flatnonzero((label_of == label) & (sizes >= max(4, min_pixels // 4)))
        groups: list[tuple[NDArray[np.bool_], cKDTree]] = []
        for number in numbers[np.argsort(-sizes[numbers])][:40]:
            piece = pieces == number
            tree = cKDTree(points[piece])
            for position, (mask, other) in enumerate(groups):
                small, large = (tree, other) if tree.n < other.n else (other, tree)
                if np.min(large.query(small.data, distance_upper_bound=gap)[0]) < gap:
                    joined = mask | piece
                    groups[position] = (joined, cKDTree(points[joined]))
                    break
            else:
                groups.append((piece, tree))
        found += [(int(label), mask) for mask, _ in groups if mask.sum() >= min_pixels]
    return found


def sharpen(labels: NDArray[np.int32], small: RgbdFrame, full: RgbdFrame) -> NDArray[np.int32]:
    """Bring labels to the full image: near borders each pixel asks the small pixels around it that look like it.

    Args:
        labels: (h, w) on `small`.
        small: the reduced frame.
        full: the frame as given.

    Returns:
        (H, W) int32 on `full`; 0 where depth is missing, but for holes inside an object.
    """
    height, width = full.depth.shape
    h, w = labels.shape
    rows = np.minimum(((np.arange(height) + 0.5) * h / height).astype(int), h - 1)
    columns = np.minimum(((np.arange(width) + 0.5) * w / width).astype(int), w - 1)
    out = labels[rows[:, None], columns[None, :]]
    if (h, w) != (height, width):
        size = np.ones((3, 3))
        as_float = labels.astype(np.float32)
        border = (cv2.dilate(as_float, size) != cv2.erode(as_float, size))[rows[:, None], columns[None, :]]
        y, x = np.nonzero(border & full.valid)
        votes = np.zeros((labels.max() + 1, len(y)), np.float32)
        for dy in (-1, 0, 1):
            for dx in (-1, 0, 1):
                yy, xx = np.clip(rows[y] + dy, 0, h - 1), np.clip(columns[x] + dx, 0, w - 1)
                gap = np.abs(full.depth[y, x] - small.depth[yy, xx]) / (3 * depth_sigma(full.depth[y, x]) + 0.002)
                change = np.abs(full.color[y, x].astype(np.float32) - small.color[yy, xx]).mean(-1) / 20
                closeness = 1.0 if dx == dy == 0 else 0.6
                vote = closeness * np.exp(-(np.minimum(gap, 6) ** 2) / 2 - np.minimum(change, 6) ** 2 / 2)
                np.add.at(votes, (labels[yy, xx], np.arange(len(y))), vote * (small.depth[yy, xx] > 0) + 1e-9)
        out[y, x] = votes.argmax(0)
    out = np.where(full.valid, out, 0).astype(np.int32)
    return _fill_holes(out, full)


def _fill_holes(labels: NDArray[np.int32], full: RgbdFrame) -> NDArray[np.int32]:
    """Missing depth that lies wholly inside one object belongs to it."""
    count, numbers, boxes, _ = cv2.connectedComponentsWithStats((~full.valid).astype(np.uint8), connectivity=4)
    for number in range(1, count):
        x, y, w, h, area = boxes[number]
        if area > 0.002 * labels.size or x == 0 or y == 0 or x + w == labels.shape[1] or y + h == labels.shape[0]:
            continue
        window = slice(y - 1, y + h + 1), slice(x - 1, x + w + 1)
        hole = (numbers[window] == number).astype(np.uint8)
        rim = (cv2.dilate(hole, np.ones((3, 3))) > 0) & (hole == 0)
        around = np.unique(labels[window][rim])
        if len(around) == 1 and around[0] > 0:
            labels[window][hole > 0] = around[0]
    return labels
