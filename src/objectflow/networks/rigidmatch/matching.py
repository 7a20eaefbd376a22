"""Global matching: every current cell against every previous cell and a dustbin."""

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
"""Initial and maximum scale of cosines."""
_FIRST_XFEAT_SCALE, _LARGEST_XFEAT_SCALE = 10.0, 30.0
"""Initial and maximum scale of XFeat's cosines."""
_FALLBACK = 1e-3
"""Weight of "static" in the expected position: it decides only where nothing matches."""
_BARRED = -1e4
_UNIT = 1 / 16
"""Unit of the prior's precision: per 16 squared cells."""


class CoarseMatch(NamedTuple):
    """N = h w cells of both frames.

    Attributes:
        scores: (B, N, N) logits, current cell first; (B, 0, 0) where no table was wanted.
        dustbin: (B, N) logits.
        rows, columns: (B, N) logarithms of the sums of their exponentials, over rows with `dustbin`.
        confidence: (B, 1, h, w) 0..1: total weight of the dual softmax.
        shift: (B, 5, h, w): expected motion, [columns, rows in cells, x, y, z in metres].
        feature: (B, C, h, w) expected feature of the previous frame.
    """

    scores: Tensor
    dustbin: Tensor
    rows: Tensor
    columns: Tensor
    confidence: Tensor
    shift: Tensor
    feature: Tensor


class GlobalMatching(nn.Module):
    """Scaled cosines of tokens and of XFeat features plus a learnt prior; dual softmax (Sun et al. 2021)."""

    def __init__(self, settings: RigidMatchSettings) -> None:
        super().__init__()
        self.project = nn.Linear(settings.channels, settings.channels)
        self.log_scale = nn.Parameter(torch.tensor(math.log(_FIRST_SCALE)))
        self.dustbin = nn.Linear(settings.channels, 1)
        # A probable position and its certainty: a plain table looks the same everywhere, and is static.
        self.prior = nn.Linear(settings.channels, 3)
        if settings.xfeat in ("score", "both"):
            self.log_xfeat_scale = nn.Parameter(torch.tensor(math.log(_FIRST_XFEAT_SCALE)))

    def forward(
        self, tokens: Tensor, curr: Grid, prev: Grid, descriptors: Tensor | None = None, *, table: bool = True
    ) -> CoarseMatch:
        """Match all cells.

        Args:
            tokens: (2 B, N, C), current frames first.
            curr, prev: the grids' points.
            descriptors: (2 B, N, 64) of unit length, XFeat's; None without them in the score.
            table: return `scores`, which losses need; without them matching takes half as long and has no gradient.
        """
        size = (curr.points.shape[-2], curr.points.shape[-1])
        with torch.autocast(tokens.device.type, enabled=False):
            tokens = tokens.float()
            current, before = tokens.chunk(2)
            position = cells(*size, tokens.device).flatten(1).T.expand(len(current), -1, -1)
            factors = self._factors(tokens, current, position, prev.valid.flatten(2).transpose(-2, -1), descriptors)
            dustbin = self.dustbin(current)[..., 0]
            there = torch.cat([position, prev.points.flatten(2).transpose(-2, -1), before], dim=-1)
            values = torch.cat([torch.ones_like(there[..., :1]), there], dim=-1)
            if table:
                scores = factors[0] @ factors[1].transpose(-2, -1)
                sums, rows, columns = dual_softmax_mean(scores, dustbin, values)
            else:
                scores = values.new_zeros(len(values), 0, 0)
                sums, rows, columns = dual_softmax_mean_of_product(*factors, dustbin, values)
            mass = sums[..., :1]
            share = sums[..., 1:] / (mass + _FALLBACK)
            here = torch.cat([position, curr.points.flatten(2).transpose(-2, -1)], dim=-1)
            # The remaining weight counts as static.
            shift = share[..., :5] - mass / (mass + _FALLBACK) * here
        return CoarseMatch(
            scores=scores,
            dustbin=dustbin,
            rows=rows,
            columns=columns,
            confidence=as_map(mass, size),
            shift=as_map(shift, size),
            feature=as_map(share[..., 5:], size),
        )

    def _factors(
        self, tokens: Tensor, current: Tensor, position: Tensor, valid: Tensor, descriptors: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        """(B, N, K) each: features, the prior's squared distance, and validity, for one product of matrices."""
        one, other = F.normalize(self.project(tokens), dim=-1).chunk(2)
        scale = self.log_scale.clamp(max=math.log(_LARGEST_SCALE)).exp()
        found = self.prior(current)
        certainty = _UNIT * F.softplus(found[..., :1])
        center = position + 4 * found[..., 1:]
        middle = position.mean(dim=1, keepdim=True)  # squares are more precise near 0
        center, target = center - middle, position - middle
        barred = _BARRED * (1 - valid)
        curr = [scale * one, -certainty * center.square().sum(-1, keepdim=True), 2 * certainty * center, -certainty]
        prev = [other, torch.ones_like(valid), target, target.square().sum(-1, keepdim=True)]
        if descriptors is not None:
            scale = self.log_xfeat_scale.clamp(max=math.log(_LARGEST_XFEAT_SCALE)).exp()
            own, others = descriptors.chunk(2)
            curr, prev = [scale * own, *curr], [others, *prev]
        return torch.cat([*curr, torch.ones_like(valid)], -1), torch.cat([*prev, barred], -1)
