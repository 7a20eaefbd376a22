"""Targets of `RigidMatch` on its grids: true cells, positions, masks and votes, from exact depth and motion."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from objectflow.geometry.moved import STATIC_DISPLACEMENT
from objectflow.training.step import Prepared

_MIN_SHARE = 0.1
"""Minimum bilinear share of a match on cells of the same object with depth; with less it has no target cell."""


class Cells(NamedTuple):
    """The true matches of a grid's cells in the previous frame's grid; h, w are those of the current grid.

    Attributes:
        cell: (B, 4, h, w) int64 indices of the four surrounding cells in the previous grid, rows first.
        share: (B, 4, h, w) bilinear shares of cells with depth and of the same object; the sum is 1, or 0 if no such
            cell exists.
        occluded: (B, h, w) bool: the point has depth and is not visible in the previous frame.
        seen: (B, h, w) bool: the point is visible in the previous frame.
        column, row: (B, h, w) the match in cells; 0 where not seen.
    """

    cell: Tensor
    share: Tensor
    occluded: Tensor
    seen: Tensor
    column: Tensor
    row: Tensor


class RigidMatchTargets(NamedTuple):
    """The targets of a batch; H, W are those of the fine grid.

    Attributes:
        coarse, fine: matches of both grids.
        coarse_position, fine_position: (B, 3, h, w) metres: each cell's point in the previous frame.
        coarse_weight, fine_weight: (B, h, w) weight of each cell in means over matches; 0 without exact depth.
        points: (B, 3, H, W) metres, exact points of the fine grid; 0 where missing.
        measured: (B, H, W) bool: where there is an exact point.
        owner: (B, H, W) int64 row in the object table, -1 for the background.
        masks: (B, K, H, W) float: each object's cells; all 0 for rows without cells.
        votes: (B, 6, H, W) metres: [X, X + T].
        in_both: (B, K) bool: the object is visible in the previous frame too.
        moving: (B, K) bool: the mean length of its flow, rather than its pose (`geometry.moved`), exceeds
            `STATIC_DISPLACEMENT`.
    """

    coarse: Cells
    fine: Cells
    coarse_position: Tensor
    fine_position: Tensor
    coarse_weight: Tensor
    fine_weight: Tensor
    points: Tensor
    measured: Tensor
    owner: Tensor
    masks: Tensor
    votes: Tensor
    in_both: Tensor
    moving: Tensor


def make_rigidmatch_targets(prepared: Prepared, stride: int, background: float) -> RigidMatchTargets:
    """The targets of a batch for grids of `stride` and of half of it, without cells beyond the image's edge.

    Args:
        prepared: from `prepare`.
        stride: pixels per coarse cell.
        background: weight of a match off the objects; the weight on objects is 1.
    """
    targets, fine = prepared.targets, stride // 2
    points = prepared.points
    measured = torch.isfinite(points).all(dim=1) & (points[:, 2] > 0)
    safe = torch.where(measured[:, None], points, torch.zeros_like(points))
    position = safe + targets.flow
    weight = torch.where(targets.mask, 1.0, background) * measured
    index = targets.index[:, ::fine, ::fine]
    K = prepared.batch.table.label.shape[1]
    masks = (index[:, None] == torch.arange(K, device=index.device)[:, None, None]).float()
    lengths = targets.flow[..., ::fine, ::fine].norm(dim=1)
    counted = masks * measured[:, None, ::fine, ::fine]
    mean_length = (counted * lengths[:, None]).sum((2, 3)) / counted.sum((2, 3)).clamp_min(1)
    return RigidMatchTargets(
        coarse=true_cells(prepared, stride),
        fine=true_cells(prepared, fine),
        coarse_position=position[..., ::stride, ::stride],
        fine_position=position[..., ::fine, ::fine],
        coarse_weight=weight[:, ::stride, ::stride],
        fine_weight=weight[:, ::fine, ::fine],
        points=safe[..., ::fine, ::fine],
        measured=measured[:, ::fine, ::fine],
        owner=index,
        masks=masks,
        votes=torch.cat([targets.center, targets.center + targets.translation], dim=1)[..., ::fine, ::fine],
        in_both=prepared.batch.table.in_both,
        moving=mean_length > STATIC_DISPLACEMENT,
    )


def true_cells(prepared: Prepared, stride: int) -> Cells:
    """The cells around each true match, with bilinear shares.

    Cells of other objects, and cells whose depth is missing in the network's input, pass their shares on to the
    remaining cells.
    """
    where = prepared.matches[..., ::stride, ::stride] / stride
    labels = prepared.batch.curr_labels[:, ::stride, ::stride]
    before = prepared.batch.prev_labels[:, ::stride, ::stride].flatten(1)
    shown = torch.isfinite(prepared.images[1][:, 2, ::stride, ::stride]).flatten(1)
    batch, height, width = labels.shape
    seen = torch.isfinite(where).all(dim=1)
    depth = torch.isfinite(prepared.points[:, 2, ::stride, ::stride])
    column, row = torch.where(seen[:, None], where, torch.zeros_like(where)).unbind(1)
    left, top = column.floor(), row.floor()
    index, share = [], []
    for right, below in ((0, 0), (1, 0), (0, 1), (1, 1)):
        x, y = left + right, top + below
        part = (1 - (column - x).abs()) * (1 - (row - y).abs())
        inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
        cell = (y.clamp(0, height - 1) * width + x.clamp(0, width - 1)).long()
        same = before.gather(1, cell.flatten(1)).view(batch, height, width) == labels
        there = shown.gather(1, cell.flatten(1)).view(batch, height, width)
        index.append(cell)
        share.append(part * (inside & same & there & seen))
    shares = torch.stack(share, dim=1)
    total = shares.sum(1, keepdim=True)
    shares = torch.where(total > _MIN_SHARE, shares / total.clamp_min(_MIN_SHARE), torch.zeros_like(shares))
    return Cells(torch.stack(index, dim=1), shares, depth & ~seen, seen, column, row)
