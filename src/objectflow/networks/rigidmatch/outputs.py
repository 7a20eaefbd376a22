"""Output of a `RigidMatch` for a batch of pairs, as losses and estimators read it."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch.nn.functional as F
from torch import Tensor

from objectflow.networks.rigidmatch.upsampling import mix_neighbors


class RigidMatchOutput(NamedTuple):
    """B pairs; h, w cells of the coarse grid, H, W of the fine one; Q queries; N = h w.

    Cell (i, j) stands for pixel (s i, s j) of its stride s. All in float32.

    Attributes:
        scores: (B, N, N) logits of "the previous cell (last) is this current cell's match"; (B, 0, 0) where no
            table was wanted.
        dustbin: (B, N) logits of "not visible in the previous frame", beside those of the cells.
        rows, columns: (B, N) logarithms of the sums of the scores' exponentials, over rows with `dustbin`.
        coarse_match: (B, 3, h, w) metres: position of each cell's point in the previous frame, camera frame.
        match: (B, 3, H, W) metres: the same for fine cells.
        window_logits: (B, (2 r + 1)^2, H, W) of the last update's window, row first; without refinement no channels.
        window_center: (B, 2, H, W) int64, column and row of its middle among the previous fine cells.
        match_confidence: (B, 1, H, W) logits of "this match is right".
        foreground: (B, 1, H, W) logits of "this is an object".
        seed: (B, 1, H, W) logits of "this vote is near the truth".
        votes: (B, 6, H, W) metres: [X, X + T], the object's centre in the current and in the previous frame.
        anchors: (B, Q, 6) metres: mean vote of each query's object, [X, X + T].
        objectness: (L, B, Q) logits of "an object", after every decoder layer and before the first.
        masks: (L, B, Q, H, W) logits likewise; (1, B, Q, H, W) of the last layer where no table was wanted.
        moves: (B, Q) logits of "it moves".
        rotation: (B, Q, 3, 3), `prev_T_curr` of each query's object.
        translation: (B, Q, 3) metres: P_prev = rotation P_curr + translation.
        upsampling: (B, 9, f^2, H, W): weights of a fine cell's neighbours in each of its f^2 parts, which are cells of
            the grid at stride 2, or pixels in networks without details; they sum to 1.
        detail_queries: (B, Q, D) and details (B, D, 2 H, 2 W): their product is added to upsampled masks. In networks
            without details D is 0.
    """

    scores: Tensor
    dustbin: Tensor
    rows: Tensor
    columns: Tensor
    coarse_match: Tensor
    match: Tensor
    window_logits: Tensor
    window_center: Tensor
    match_confidence: Tensor
    foreground: Tensor
    seed: Tensor
    votes: Tensor
    anchors: Tensor
    objectness: Tensor
    masks: Tensor
    moves: Tensor
    rotation: Tensor
    translation: Tensor
    upsampling: Tensor
    detail_queries: Tensor
    details: Tensor

    def rescaled(self, factor: Tensor) -> RigidMatchOutput:
        """The output with all lengths of each pair multiplied by its factor (B,)."""
        lengths = ("coarse_match", "match", "votes", "anchors", "translation")
        changed = {}
        for name in lengths:
            value = getattr(self, name)
            changed[name] = value * factor.reshape(-1, *[1] * (value.ndim - 1))
        return self._replace(**changed)


def upsampled_masks(masks: Tensor, upsampling: Tensor, queries: Tensor, details: Tensor) -> Tensor:
    """Mask logits on the finest grid of the network: that at stride 2, or pixels in networks without details.

    Args:
        masks: (B, K, H, W) logits on the fine grid.
        upsampling: (B, 9, f^2, H, W).
        queries: (B, K, D) detail queries of the same objects.
        details: (B, D, 2 H, 2 W).

    Returns:
        (B, K, f H, f W).
    """
    out = mix_neighbors(masks, upsampling)
    if not queries.shape[-1]:
        return out
    return out + (queries @ details.flatten(2)).reshape(out.shape) / math.sqrt(queries.shape[-1])


def pixel_masks(masks: Tensor, upsampling: Tensor, queries: Tensor, details: Tensor) -> Tensor:
    """`upsampled_masks` at every pixel: (B, K, H', W')."""
    out = upsampled_masks(masks, upsampling, queries, details)
    return between_cells(out) if queries.shape[-1] else out


def between_cells(masks: Tensor) -> Tensor:
    """Mask logits (B, K, h, w) on the grid at stride 2 at every pixel, between cells linearly: (B, K, 2 h, 2 w)."""
    # Cell (i, j) stands for pixel (2 i, 2 j), so the last row and column of pixels lie beyond the last cells.
    height, width = masks.shape[-2:]
    between = F.interpolate(masks, (2 * height - 1, 2 * width - 1), mode="bilinear", align_corners=True)
    return F.pad(between, (0, 1, 0, 1), mode="replicate")
