"""From the coarse to the fine grid: learnt upsampling, and updates of each match in a small window."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from objectflow.networks.rigidmatch.inputs import Grid, as_map, cells
from objectflow.networks.rigidmatch.matching import CoarseMatch
from objectflow.networks.rigidmatch.settings import RigidMatchSettings

_FIRST_SCALE, _LARGEST_SCALE = 8.0, 60.0
_BARRED = -1e4


class FineMatch(NamedTuple):
    """What is known of the fine grid's matches.

    Attributes:
        match: (B, 3, H, W) metres, in the previous frame.
        confidence: (B, 1, H, W) 0..1, the coarse grid's.
        logits: (B, (2 r + 1)^2, H, W) over the last window; no channels without updates.
        center: (B, 2, H, W) int64: column and row of its middle.
        peak: (B, 1, H, W) 0..1: the window's largest probability; 1 without updates.
    """

    match: Tensor
    confidence: Tensor
    logits: Tensor
    center: Tensor
    peak: Tensor


def mix_neighbors(values: Tensor, weights: Tensor) -> Tensor:
    """Each fine value as a weighted mean of 3x3 coarse ones (convex upsampling, Teed and Deng 2020).

    Args:
        values: (B, C, h, w).
        weights: (B, 9, S, h, w), which sum to 1 over the second axis, for S = f^2 sub-cells, row first.

    Returns:
        (B, C, f h, f w).
    """
    batch, channels, height, width = values.shape
    factor = math.isqrt(weights.shape[2])
    # Not by F.pad, whose gradient torch.compile cannot follow where channels are innermost.
    wide = torch.cat([values[..., :1], values, values[..., -1:]], dim=-1)
    padded = torch.cat([wide[..., :1, :], wide, wide[..., -1:, :]], dim=-2)
    out = torch.zeros((), device=values.device, dtype=values.dtype)
    for k in range(9):
        row, column = divmod(k, 3)
        neighbor = padded[..., row : row + height, column : column + width]
        out = out + neighbor[:, :, None] * weights[:, k][:, None]
    out = out.reshape(batch, channels, factor, factor, height, width)
    return out.permute(0, 1, 4, 2, 5, 3).reshape(batch, channels, factor * height, factor * width)


class Refinement(nn.Module):
    """Coarse matches to the fine grid, then `updates` expectations over a window of the previous fine features."""

    def __init__(self, settings: RigidMatchSettings) -> None:
        super().__init__()
        self.settings = settings
        fine, coarse = settings.fine_channels, settings.channels
        self.guide = nn.Sequential(
            nn.Conv2d(fine + coarse, coarse, 1), nn.ReLU(inplace=True), nn.Conv2d(coarse, 36, 1)
        )
        if settings.updates:
            self.own = nn.Conv2d(fine, fine // 2, 1)
            self.from_tokens = nn.Conv2d(coarse, fine // 2, 1)
            self.log_scale = nn.Parameter(torch.tensor(math.log(_FIRST_SCALE)))

    def forward(self, fine: Tensor, tokens: Tensor, coarse: CoarseMatch, curr: Grid, prev: Grid) -> FineMatch:
        """Refine.

        Args:
            fine: (2 B, C, H, W) features of the fine grid, current frames first.
            tokens: (2 B, C', h, w) of the coarse one, after attention.
            coarse: its matches.
            curr, prev: the fine grid's points.
        """
        here = fine.chunk(2)[0]
        coarse_here = tokens.chunk(2)[0]
        guide = self.guide(torch.cat([F.avg_pool2d(here, 2), coarse_here], dim=1))
        with torch.autocast(fine.device.type, enabled=False):
            weights = guide.float().reshape(len(guide), 9, 4, *guide.shape[-2:]).softmax(dim=1)
            upsampled = mix_neighbors(torch.cat([coarse.shift, coarse.confidence], dim=1), weights)
            shift, confidence = upsampled[:, :5], upsampled[:, 5:]
            match = curr.points + shift[:, 2:]
            place = cells(shift.shape[-2], shift.shape[-1], fine.device) + 2 * shift[:, :2]
        if not self.settings.updates:
            nothing = match[:, :0]
            center = place.detach().round().long()
            return FineMatch(match, confidence, nothing, center, torch.ones_like(confidence))
        looks = self.own(fine) + F.interpolate(self.from_tokens(tokens), scale_factor=2.0, mode="nearest")
        with torch.autocast(fine.device.type, enabled=False):
            one, other = F.normalize(looks.float(), dim=1).chunk(2)
            scale = self.log_scale.clamp(max=math.log(_LARGEST_SCALE)).exp()
            for update in range(self.settings.updates):
                last = update == self.settings.updates - 1
                # Updates before the last only say where to look: nothing is learnt from them.
                with torch.set_grad_enabled(last and torch.is_grad_enabled()):
                    logits, center, place, match, peak = _update(
                        scale * one, other, prev, place.detach(), self.settings.window
                    )
        return FineMatch(match, confidence, logits, center, peak)


def _update(
    one: Tensor, other: Tensor, prev: Grid, place: Tensor, window: int
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Logits, middle, expected place and point over a window around each place; and the largest probability."""
    batch, _, height, width = one.shape
    side = 2 * window + 1
    limit = torch.tensor([width - 1, height - 1], device=one.device, dtype=place.dtype).reshape(1, 2, 1, 1)
    center = torch.minimum(place.round().clamp_min(0), limit).long()
    offset = torch.arange(-window, window + 1, device=one.device)
    column = (center[:, 0, None] + offset.repeat(side)[:, None, None]).flatten(2)
    row = (center[:, 1, None] + offset.repeat_interleave(side)[:, None, None]).flatten(2)
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    index = row.clamp(0, height - 1) * width + column.clamp(0, width - 1)
    start = torch.arange(batch, device=one.device)[:, None, None] * (height * width)
    flat = (index + start).flatten()
    # One row a cell, gathered whole: point, validity, and the feature.
    table = (
        torch.cat([prev.points, prev.valid, other], dim=1)
        .flatten(2)
        .transpose(-2, -1)
        .reshape(batch * height * width, -1)
    )
    found = table.index_select(0, flat).reshape(batch, side * side, height * width, -1)
    logits = (found[..., 4:] * one.flatten(2).transpose(-2, -1)[:, None]).sum(-1)
    logits = torch.where(inside & (found[..., 3] > 0.5), logits, _BARRED)
    share = logits.softmax(dim=1)
    point = as_map((share[..., None] * found[..., :3]).sum(1), (height, width))
    moved = torch.stack([(share * column).sum(1), (share * row).sum(1)], dim=1).reshape(batch, 2, height, width)
    peak = share.amax(dim=1, keepdim=True).reshape(batch, 1, height, width)
    return logits.reshape(batch, -1, height, width), center, moved, point, peak
