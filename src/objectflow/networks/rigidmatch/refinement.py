"""Refinement of matches: learnt upsampling to the fine grid, then updates within a small window."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from objectflow.networks.rigidmatch.inputs import Grid, as_map, cells
from objectflow.networks.rigidmatch.matching import CoarseMatch
from objectflow.networks.rigidmatch.settings import RigidMatchSettings
from objectflow.networks.rigidmatch.upsampling import mix_neighbors
from objectflow.networks.rigidmatch.window_geometry import WindowGeometry
from objectflow.networks.xfeat import CHANNELS as XFEAT_CHANNELS

_FIRST_SCALE, _LARGEST_SCALE = 8.0, 60.0
_BARRED = -1e4


_CELLS = 512
"""Cells per block at inference; the windows of a block fit into the processor's cache."""

Scorer = Callable[[Tensor, Tensor, slice], Tensor]


class FineMatch(NamedTuple):
    """The fine grid's matches.

    Attributes:
        match: (B, 3, H, W) metres, in the previous frame.
        confidence: (B, 1, H, W) 0..1, upsampled from the coarse grid.
        logits: (B, (2 r + 1)^2, H, W) over the last window, r its radius; no channels without updates.
        center: (B, 2, H, W) int64: column and row of the window's middle.
        peak: (B, 1, H, W) 0..1: largest probability within the window; 1 without updates.
    """

    match: Tensor
    confidence: Tensor
    logits: Tensor
    center: Tensor
    peak: Tensor


class Refinement(nn.Module):
    """Upsamples coarse matches, then updates them by expectations over a window of the previous frame's cells."""

    def __init__(self, settings: RigidMatchSettings) -> None:
        super().__init__()
        self.settings = settings
        fine, coarse = settings.fine_channels, settings.channels
        self.guide = nn.Sequential(
            nn.Conv2d(fine + coarse, coarse, 1), nn.ReLU(inplace=True), nn.Conv2d(coarse, 36, 1)
        )
        if settings.updates:
            self.project = nn.Conv2d(fine, fine // 2, 1)
            self.from_tokens = nn.Conv2d(coarse, fine // 2, 1)
            self.from_xfeat = nn.Conv2d(XFEAT_CHANNELS, fine // 2, 1) if settings.xfeat != "none" else None
            self.log_scale = nn.Parameter(torch.tensor(math.log(_FIRST_SCALE)))
            self.geometry = WindowGeometry(fine) if settings.window_geometry else None

    def forward(
        self,
        fine: Tensor,
        tokens: Tensor,
        coarse: CoarseMatch,
        curr: Grid,
        prev: Grid,
        descriptors: Tensor | None = None,
        *,
        blocks: bool = False,
    ) -> FineMatch:
        """Refine matches.

        Args:
            fine: (2 B, C, H, W) features of the fine grid, current frames first.
            tokens: (2 B, C', h, w) of the coarse grid, after attention.
            coarse: the coarse grid's matches.
            curr, prev: the fine grid's points.
            descriptors: (2 B, 64, H, W) of XFeat; None for networks without.
            blocks: update matches in blocks, which takes half the time on a CPU.
        """
        here = fine.chunk(2)[0]
        coarse_here = tokens.chunk(2)[0]
        guide = self.guide(torch.cat([F.avg_pool2d(here, 2), coarse_here], dim=1))
        with torch.autocast(fine.device.type, enabled=False):
            weights = guide.float().reshape(len(guide), 9, 4, *guide.shape[-2:]).softmax(dim=1)
            upsampled = mix_neighbors(torch.cat([coarse.shift, coarse.confidence], dim=1), weights)
            shift, confidence = upsampled[:, :5], upsampled[:, 5:]
            match = curr.points + shift[:, 2:]
            position = cells(shift.shape[-2], shift.shape[-1], fine.device) + 2 * shift[:, :2]
        if not self.settings.updates:
            nothing = match[:, :0]
            center = position.detach().round().long()
            return FineMatch(match, confidence, nothing, center, torch.ones_like(confidence))
        features = self.project(fine) + F.interpolate(self.from_tokens(tokens), scale_factor=2.0, mode="nearest")
        if self.from_xfeat is not None:
            features = features + self.from_xfeat(descriptors)
        context = None if self.geometry is None else self.geometry.context(here).float()
        with torch.autocast(fine.device.type, enabled=False):
            one, other = F.normalize(features.float(), dim=1).chunk(2)
            scale = self.log_scale.clamp(max=math.log(_LARGEST_SCALE)).exp()
            for update in range(self.settings.updates):
                last = update == self.settings.updates - 1
                # Updates before the last only move the window: they have no gradient.
                with torch.set_grad_enabled(last and torch.is_grad_enabled()):
                    logits, center, position, match, peak = update_matches(
                        scale * one,
                        other,
                        prev,
                        position.detach(),
                        self.settings.window,
                        self._scorer(context, match),
                        blocks=blocks,
                    )
        return FineMatch(match, confidence, logits, center, peak)

    def _scorer(self, context: Tensor | None, match: Tensor) -> Scorer | None:
        geometry = self.geometry
        if geometry is None or context is None:
            return None
        given, reference = context.flatten(2), match.detach().flatten(2)
        return lambda logits, points, part: geometry(given[..., part], logits, points, reference[..., part])


def update_matches(
    one: Tensor,
    other: Tensor,
    prev: Grid,
    position: Tensor,
    window: int,
    scorer: Scorer | None = None,
    *,
    blocks: bool = False,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Logits, middle, expected position and point over a window around each position; and the largest probability.

    `scorer` gives logits to add, from the correlation (B, n, S) and the points (B, n, S, 3) of the windows of a slice
    of the N cells. With `blocks`, cells are updated block by block.
    """
    height, width = one.shape[-2:]
    limit = torch.tensor([width - 1, height - 1], device=one.device, dtype=position.dtype).reshape(1, 2, 1, 1)
    center = torch.minimum(position.round().clamp_min(0), limit).long()
    # One row per cell, gathered whole: point, validity, and the feature.
    table = torch.cat([prev.points, prev.valid, other], dim=1).flatten(2).transpose(-2, -1).flatten(0, 1)
    features, middle = one.flatten(2).transpose(-2, -1), center.flatten(2)
    count = height * width
    size = _CELLS if blocks else count
    parts = [
        _update_cells(table, features, middle, (height, width), window, scorer, slice(start, min(count, start + size)))
        for start in range(0, count, size)
    ]
    logits, point, step, peak = (torch.cat(found, dim=1) for found in zip(*parts, strict=True))
    moved = center + as_map(step, (height, width))
    logits, point, peak = (as_map(found, (height, width)) for found in (logits, point, peak))
    return logits, center, moved, point, peak


def _update_cells(
    table: Tensor,
    features: Tensor,
    center: Tensor,
    size: tuple[int, int],
    window: int,
    scorer: Scorer | None,
    part: slice,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The update of a slice of n cells.

    Args:
        table: (B N, 4 + C) point, validity and feature of the previous frame's cells.
        features: (B, N, C) of the current cells.
        center: (B, 2, N) column and row of each window's middle.
        size: (H, W) of the grid.
        window, scorer: see `update_matches`.
        part: the cells.

    Returns:
        (B, n, S) logits, (B, n, 3) expected point, (B, n, 2) expected step from the middle, (B, n, 1) largest
        probability.
    """
    height, width = size
    side = 2 * window + 1
    offset = torch.arange(-window, window + 1, device=table.device)
    steps = torch.stack([offset.repeat(side), offset.repeat_interleave(side)], dim=1)
    column, row = (center[:, axis, part, None] + steps[:, axis] for axis in (0, 1))
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    index = row.clamp(0, height - 1) * width + column.clamp(0, width - 1)
    start = torch.arange(len(center), device=table.device)[:, None, None] * (height * width)
    found = table.index_select(0, (index + start).flatten()).reshape(*index.shape, -1)
    points, valid, others = torch.split(found, [3, 1, features.shape[-1]], dim=-1)
    logits = (others @ features[:, part, :, None])[..., 0]
    if scorer is not None:
        logits = logits + scorer(logits, points, part)
    logits = torch.where(inside & (valid[..., 0] > 0.5), logits, _BARRED)
    share = logits.softmax(dim=-1)
    point = (share[..., None, :] @ points)[..., 0, :]
    return logits, point, share @ steps.to(share), share.amax(dim=-1, keepdim=True)
