"""Random walker with priors (Grady, CVPR 2005): label probabilities that spread along surfaces."""

from __future__ import annotations

import cv2
import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from objectflow.methods.consensus.pixel_graph import PixelGraph
from objectflow.typing import BoolMask, Float32Array, Float64Array, IndexArray

_DAMPING = 0.8
"""Factor on the steps of Jacobi's method. With 4/5 it smooths the errors of a five-point Laplacian fastest."""
_SMOOTHING_STEPS = 4
"""Steps of Jacobi's method in each two-grid cycle."""
_MIN_PRIOR = 1e-3
"""Weight of the likelihood of a pixel whose motions cost the same, and the likelihood, relative to this weight, from
which a motion may claim a pixel."""


class RandomWalker:
    """Solves for label probabilities on one frame's pixel graph."""

    def __init__(self, graph: PixelGraph) -> None:
        self.shape = graph.shape
        self._laplacian = graph.laplacian
        self._blocks = _blocks(graph.shape)
        self._coarse_laplacian = (self._blocks.T @ graph.laplacian @ self._blocks).tocsc()

    def solve(self, costs: Float32Array, *, fine: bool = True) -> Float32Array:
        """The probability that a random walk from each pixel ends at each motion.

        Args:
            costs: (K, H, W) negative log-likelihoods.
            fine: whether the solution is per pixel; otherwise 2x2 blocks share one, in half the time.

        Returns:
            (K, H, W) probabilities. The weight of a pixel's own likelihood is its margin, so that undecided pixels
            follow their surface.
        """
        likelihood = np.exp(-(costs - costs.min(0)))
        prior = (likelihood / likelihood.sum(0)).reshape(len(costs), -1).astype(np.float64)
        top = np.partition(prior, -2, axis=0)[-2:] if len(costs) > 1 else np.stack([prior[0] * 0, prior[0]])
        weight = (top[1] - top[0]) + _MIN_PRIOR
        solution = self._two_grid(weight, (prior * weight).T, cycles=2 if fine else 0)
        return np.asarray(solution.T.reshape(costs.shape), dtype=np.float32)

    def _two_grid(self, weight: Float64Array, right: Float64Array, *, cycles: int) -> Float64Array:
        """Solve exactly on 2x2 blocks and by smoothing on pixels, in a fifth of the time of a full solve.

        A two-grid cycle with Galerkin's coarse system and damped Jacobi. Labels are an argmax, so the last digits do
        not matter.
        """
        contested = self._contested(weight, right)
        coarse = _CoarseSystem(self._coarse_laplacian, self._blocks.T @ weight, contested)
        anchor = weight[:, None]
        step = (_DAMPING / (self._laplacian.diagonal() + weight))[:, None]
        solution = self._blocks @ coarse.solve(self._blocks.T @ right)
        for cycle in range(cycles):
            for _ in range(_SMOOTHING_STEPS):
                solution += step * (right - self._laplacian @ solution - anchor * solution)
            if cycle + 1 < cycles:
                residual = right - self._laplacian @ solution - anchor * solution
                solution += self._blocks @ coarse.correct(self._blocks.T @ residual)
        return np.asarray(solution)

    def _contested(self, weight: Float64Array, right: Float64Array) -> BoolMask:
        """(h w,) bool: blocks that any motion but the first may claim, and those within eight pixels of them.

        Label information reaches about sqrt(30) pixels; isolated blocks receive none and stay background.
        """
        height, width = self.shape
        claim = (right[:, 1:].max(axis=1, initial=0) > _MIN_PRIOR * weight).astype(np.float64)
        touched = (self._blocks.T @ claim > 0).reshape((height + 1) // 2, (width + 1) // 2)
        return np.asarray(cv2.dilate(touched.astype(np.uint8), np.ones((9, 9))).ravel() > 0)


class _CoarseSystem:
    """The system on blocks, factorised where motions compete; elsewhere each block keeps its own probability.

    Over a table most of the image is uncontested background, and a factorisation takes more than linear time.
    """

    def __init__(self, laplacian: sparse.csc_array, weight: Float64Array, contested: BoolMask) -> None:
        self._inner: IndexArray = np.flatnonzero(contested)
        self._outer: IndexArray = np.flatnonzero(~contested)
        self._weight = weight
        rows = (laplacian + sparse.diags_array(weight)).tocsr()[self._inner]
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
        """(blocks, K) probabilities."""
        solution = right / self._weight[:, None]
        if self._factor is not None:
            known = self._across @ solution[self._outer]
            solution[self._inner] = self._factor.solve(right[self._inner] - known)
        return solution

    def correct(self, residual: Float64Array) -> Float64Array:
        """(blocks, K) correction of the contested blocks for a residual."""
        correction = np.zeros_like(residual)
        if self._factor is not None:
            correction[self._inner] = self._factor.solve(residual[self._inner])
        return correction


def _blocks(shape: tuple[int, int]) -> sparse.csr_array:
    """(H W, h w) matrix of 0 and 1: the 2x2 block of each pixel."""
    height, width = shape
    row, column = np.mgrid[0:height, 0:width] // 2
    block = (row * ((width + 1) // 2) + column).ravel()
    ones = np.ones(height * width)
    return sparse.csr_array((ones, (np.arange(height * width), block)))
