"""Everything that a `RigidMatch` says about a pair: what the losses judge and what estimators read."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor


class RigidMatchOutput(NamedTuple):
    """B pairs; h, w cells of the coarse grid, H, W of the fine one; Q queries; N = h w.

    Cell (i, j) stands for pixel (s i, s j) of its stride s. All in float32.

    Attributes:
        scores: (B, N, N) logits of "the previous cell (last) is this current cell's match"; (B, 0, 0) where no
            table was wanted.
        hidden: (B, N) logits of "the previous frame does not show it", beside those of the cells.
        rows, columns: (B, N) logarithms of the sums of the scores' exponentials, over rows with `hidden`.
        coarse_match: (B, 3, h, w) metres: where each cell's point was in the previous frame, camera frame.
        match: (B, 3, H, W) metres: the same for fine cells.
        window_logits: (B, (2 r + 1)^2, H, W) of the last update's window, row first; without refinement no channels.
        window_center: (B, 2, H, W) int64, column and row of its middle among the previous fine cells.
        reliability: (B, 1, H, W) logits of "this match is right".
        foreground: (B, 1, H, W) logits of "this is an object".
        seed: (B, 1, H, W) logits of "this vote is near the truth".
        votes: (B, 6, H, W) metres: [X, X + T], the object's centre in the current and in the previous frame.
        anchors: (B, Q, 6) metres: where the votes of each query's object lie, [X, X + T].
        objectness: (L, B, Q) logits of "an object", after every decoder layer and before the first.
        masks: (L, B, Q, H, W) logits likewise.
        moves: (B, Q) logits of "it moves".
        rotation: (B, Q, 3, 3), `prev_T_curr` of each query's object.
        translation: (B, Q, 3) metres: P_prev = rotation P_curr + translation.
        upsampling: (B, 9, f^2, H, W): weights of the neighbours of a fine cell in each of its pixels; they sum to 1.
    """

    scores: Tensor
    hidden: Tensor
    rows: Tensor
    columns: Tensor
    coarse_match: Tensor
    match: Tensor
    window_logits: Tensor
    window_center: Tensor
    reliability: Tensor
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
