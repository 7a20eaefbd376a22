"""Pixels tied along surfaces: a random walk that stops at edges, and the separate pieces of a label."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from scipy import sparse
from scipy.sparse import csgraph
from scipy.sparse.linalg import splu
from scipy.spatial import cKDTree

from objectflow import geometry
from objectflow.frame import RgbdFrame
from objectflow.geometry.depth_noise import depth_sigma
from objectflow.geometry.normals import surface_normals
from objectflow.typing import BoolMask, Float32Array, Float64Array, LabelImage

_EDGE_WEIGHT = 30.0
"""Strength of the tie between two pixels of one smooth, evenly coloured surface, against 1 for a certain pixel."""


class PixelGraph:
    """The ties between neighbouring pixels of the current frame: weak across depth steps, creases and colour edges."""

    def __init__(self, frame: RgbdFrame) -> None:
        depth = frame.depth
        self.shape = depth.shape
        index = np.arange(depth.size).reshape(depth.shape)
        points = geometry.back_project(depth, frame.camera)
        normals = surface_normals(cv2.medianBlur(depth, 5), frame.camera)
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
        depth: Float32Array, points: Float32Array, normals: Float32Array, color: Float32Array, here: Any, there: Any
    ) -> tuple[Float64Array, BoolMask]:
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
        tie = _EDGE_WEIGHT * (0.12 + 0.88 * np.exp(-((change / 25) ** 2))) * np.exp(-((gap / allowed) ** 2)) + 0.02
        tie = np.where(crease, 0.15 * tie, tie)
        tie = np.where(both, tie, 0.05 * _EDGE_WEIGHT * np.exp(-((change / 15) ** 2)) + 0.02)
        return np.where(step, 0.01, tie), step

    def walk(self, costs: Float32Array, *, fine: bool = True) -> Float32Array:
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

    def _two_grid(self, pull: Float64Array, right: Float64Array, *, cycles: int) -> Float64Array:
        """Solve the walk on 2x2 blocks exactly, on pixels by smoothing, twice: a fifth of the time of a full solve.

        A textbook two-grid cycle with Galerkin's coarse system and damped Jacobi; labels are an argmax, so the last
        digits do not matter.
        """
        coarse = _CoarseRandomWalk(self.coarse_laplacian, self.blocks.T @ pull, self._contested(pull, right))
        anchor = pull[:, None]
        step = (0.8 / (self.laplacian.diagonal() + pull))[:, None]
        solution = self.blocks @ coarse.solve(self.blocks.T @ right)
        for cycle in range(cycles):
            for _ in range(4):
                solution += step * (right - self.laplacian @ solution - anchor * solution)
            if cycle + 1 < cycles:
                residual = right - self.laplacian @ solution - anchor * solution
                solution += self.blocks @ coarse.correct(self.blocks.T @ residual)
        return np.asarray(solution)

    def _contested(self, pull: Float64Array, right: Float64Array) -> BoolMask:
        """(h w,) bool: blocks that any motion but the first may claim, and their surroundings.

        Edges of `_EDGE_WEIGHT` carry label information over about sqrt(30) pixels; blocks more than eight pixels away
        from every claim receive none and stay background.
        """
        height, width = self.shape
        claim = (right[:, 1:].max(axis=1, initial=0) > 1e-3 * pull).astype(np.float64)
        touched = (self.blocks.T @ claim > 0).reshape((height + 1) // 2, (width + 1) // 2)
        return np.asarray(cv2.dilate(touched.astype(np.uint8), np.ones((9, 9))).ravel() > 0)

    def components(self, labels: LabelImage) -> LabelImage:
        """(H, W) component numbers: pixels of one label, joined where no depth step divides them."""
        flat = labels.ravel()
        joined = (flat[self.head] == flat[self.tail]) & ~self.step
        n = flat.size
        graph = sparse.coo_array(
            (np.ones(joined.sum(), np.int8), (self.head[joined], self.tail[joined])), shape=(n, n)
        )
        _, numbers = csgraph.connected_components(graph, directed=False)
        return np.asarray(numbers.reshape(self.shape), dtype=np.int32)


class _CoarseRandomWalk:
    """The walk on blocks, solved exactly where motions compete; elsewhere each block keeps its own opinion.

    Over a table most of the image is nobody's but the background's, and a factorisation costs more than its share.
    """

    def __init__(self, laplacian: sparse.csc_array, pull: Float64Array, contested: BoolMask) -> None:
        self._inner, self._outer = np.flatnonzero(contested), np.flatnonzero(~contested)
        self._pull = pull
        rows = (laplacian + sparse.diags_array(pull)).tocsr()[self._inner]
        self._across = rows[:, self._outer]
        self._factor = None
        if len(self._inner):
            self._factor = splu(
                rows[:, self._inner].tocsc(),
                permc_spec="MMD_AT_PLUS_A",
                diag_pivot_thresh=0.0,
                options={"SymmetricMode": True},
            )

    def solve(self, right: Float64Array) -> Float64Array:
        """(blocks, K) the walk's shares."""
        solution = right / self._pull[:, None]
        if self._factor is not None:
            known = self._across @ solution[self._outer]
            solution[self._inner] = self._factor.solve(right[self._inner] - known)
        return solution

    def correct(self, residual: Float64Array) -> Float64Array:
        """(blocks, K) what a residual adds to the shares of the contested blocks."""
        correction = np.zeros_like(residual)
        if self._factor is not None:
            correction[self._inner] = self._factor.solve(residual[self._inner])
        return correction


def _blocks(shape: tuple[int, int]) -> sparse.csr_array:
    """(H W, h w) 0/1 matrix: which 2x2 block a pixel lies in."""
    height, width = shape
    row, column = np.mgrid[0:height, 0:width] // 2
    block = (row * ((width + 1) // 2) + column).ravel()
    ones = np.ones(height * width)
    return sparse.csr_array((ones, (np.arange(height * width), block)))


def split_regions(
    labels: LabelImage, points: Float32Array, graph: PixelGraph, *, min_pixels: int, gap: float
) -> list[tuple[int, BoolMask]]:
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
    found: list[tuple[int, BoolMask]] = []
    for label in np.unique(labels[labels > 0]):
        numbers = np.flatnonzero((label_of == label) & (sizes >= max(4, min_pixels // 4)))
        groups: list[tuple[BoolMask, cKDTree]] = []
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
