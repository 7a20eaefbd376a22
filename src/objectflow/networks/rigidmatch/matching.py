"""Global matching: every current cell against every previous one, or against 'hidden'."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from objectflow.networks.rigidmatch.dual_softmax import dual_softmax_mean, dual_softmax_mean_of_product
from objectflow.networks.rigidmatch.inputs import Grid, as_map, cells
from objectflow.networks.rigidmatch.settings import RigidMatchSettings

_FIRST_SCALE, _LARGEST_SCALE = 12.0, 60.0
"""Of cosines into logits: where learning starts, and where it ends."""
_FALLBACK = 1e-3
"""Weight of "it did not move" in the expected position: decides only where nothing matches."""
_BARRED = -1e4
_UNIT = 1 / 16
"""Of squared distances in cells, in the prior."""


class CoarseMatch(NamedTuple):
    """N = h w cells of both frames.

    Attributes:
        scores: (B, N, N) logits, current cell first; (B, 0, 0) where no table was wanted.
        hidden: (B, N) logits.
        rows, columns: (B, N) logarithms of the sums of their exponentials, over rows with `hidden`.
        confidence: (B, 1, h, w) 0..1: how much of both frames' softmax agrees.
        shift: (B, 5, h, w): expected motion, [columns, rows in cells, x, y, z in metres].
        feature: (B, C, h, w) expected feature of the previous frame.
    """

    scores: Tensor
    hidden: Tensor
    rows: Tensor
    columns: Tensor
    confidence: Tensor
    shift: Tensor
    feature: Tensor


class GlobalMatching(nn.Module):
    """Cosines of projected tokens times a learnt scale, and a learnt prior; dual softmax (Sun et al. 2021)."""

    def __init__(self, settings: RigidMatchSettings) -> None:
        super().__init__()
        self.reach = settings.reach if settings.matching == "windowed" else None
        self.project = nn.Linear(settings.channels, settings.channels)
        self.log_scale = nn.Parameter(torch.tensor(math.log(_FIRST_SCALE)))
        self.hidden = nn.Linear(settings.channels, 1)
        # Where a cell probably was, and how surely: a table looks the same everywhere, and stays where it is.
        self.prior = nn.Linear(settings.channels, 3)

    def forward(self, tokens: Tensor, curr: Grid, prev: Grid, *, table: bool = True) -> CoarseMatch:
        """Match.

        Args:
            tokens: (2 B, N, C), current frames first.
            curr, prev: the grids' points.
            table: give `scores`, which losses need. Without them it takes half as long, and no gradient.
        """
        size = (curr.points.shape[-2], curr.points.shape[-1])
        with torch.autocast(tokens.device.type, enabled=False):
            tokens = tokens.float()
            looks, before = tokens.chunk(2)
            place = cells(*size, tokens.device).flatten(1).T.expand(len(looks), -1, -1)
            factors = self._factors(tokens, looks, place, prev.valid.flatten(2).transpose(-2, -1))
            hidden = self.hidden(looks)[..., 0]
            there = torch.cat([place, prev.points.flatten(2).transpose(-2, -1), before], dim=-1)
            values = torch.cat([torch.ones_like(there[..., :1]), there], dim=-1)
            if table or self.reach is not None:
                scores = self._scores(*factors, place)
                sums, rows, columns = dual_softmax_mean(scores, hidden, values)
            else:
                scores = values.new_zeros(len(values), 0, 0)
                sums, rows, columns = dual_softmax_mean_of_product(*factors, hidden, values)
            mass = sums[..., :1]
            share = sums[..., 1:] / (mass + _FALLBACK)
            here = torch.cat([place, curr.points.flatten(2).transpose(-2, -1)], dim=-1)
            # The missing share did not move.
            shift = share[..., :5] - mass / (mass + _FALLBACK) * here
        return CoarseMatch(
            scores=scores,
            hidden=hidden,
            rows=rows,
            columns=columns,
            confidence=as_map(mass, size),
            shift=as_map(shift, size),
            feature=as_map(share[..., 5:], size),
        )

    def _factors(self, tokens: Tensor, looks: Tensor, place: Tensor, valid: Tensor) -> tuple[Tensor, Tensor]:
        """(B, N, K) each: looks, the prior's squared distance, and validity, in one product of matrices."""
        one, other = F.normalize(self.project(tokens), dim=-1).chunk(2)
        scale = self.log_scale.clamp(max=math.log(_LARGEST_SCALE)).exp()
        found = self.prior(looks)
        sure = _UNIT * F.softplus(found[..., :1])
        center = place + 4 * found[..., 1:]
        middle = place.mean(dim=1, keepdim=True)  # near 0, squares keep their digits
        center, target = center - middle, place - middle
        barred = _BARRED * (1 - valid)
        curr = [scale * one, -sure * center.square().sum(-1, keepdim=True), 2 * sure * center, -sure]
        prev = [other, torch.ones_like(valid), target, target.square().sum(-1, keepdim=True)]
        return torch.cat([*curr, torch.ones_like(valid)], -1), torch.cat([*prev, barred], -1)

    def _scores(self, left: Tensor, right: Tensor, place: Tensor) -> Tensor:
        scores = left @ right.transpose(-2, -1)
        if self.reach is not None:
            far = (place[0, :, None] - place[0, None]).abs().amax(-1) > self.reach
            scores = scores + _BARRED * far.to(scores.dtype)
        return scores
