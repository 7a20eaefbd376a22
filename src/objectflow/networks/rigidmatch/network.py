"""The network: encode, attend, match, refine, predict votes, find objects, solve for their motions."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from objectflow.errors import MethodError
from objectflow.networks.rigidmatch.attention import FrameAttention, Positions
from objectflow.networks.rigidmatch.decoder import Objects, SetDecoder
from objectflow.networks.rigidmatch.dense_head import DenseHead, DensePredictions
from objectflow.networks.rigidmatch.encoder import Block, Encoder
from objectflow.networks.rigidmatch.inputs import Grid, as_map, cells, encode_inputs, grid
from objectflow.networks.rigidmatch.matching import CoarseMatch, GlobalMatching
from objectflow.networks.rigidmatch.outputs import RigidMatchOutput
from objectflow.networks.rigidmatch.refinement import FineMatch, Refinement
from objectflow.networks.rigidmatch.rigid_solver import agreement, solve_motions
from objectflow.networks.rigidmatch.settings import RigidMatchSettings
from objectflow.networks.xfeat import CHANNELS as XFEAT_CHANNELS
from objectflow.networks.xfeat import XFeat, sample_cells

PRIOR = 1.0
"""Number of matches that the votes' motion is worth in the solve."""
_AGREE = 0.02
"""Distance in metres from its object's motion at which a match weighs half."""
_STEP = 2
"""Coarse cells per side of a context cell."""


class Features(NamedTuple):
    """Everything that is predicted before motions are solved.

    Attributes:
        coarse_points, points: of the current frame's grids.
        matched, refined: the matches of both.
        dense: dense predictions.
        objects: Q queries.
        moves: (B, Q) logits.
    """

    coarse_points: Grid
    points: Grid
    matched: CoarseMatch
    refined: FineMatch
    dense: DensePredictions
    objects: Objects
    moves: Tensor

    def weights(self) -> Tensor:
        """(B, Q, H, W) weights of matches in each object's solve: mask times match confidence, 0 without depth."""
        return self.objects.masks[-1].sigmoid() * self.dense.match_confidence.sigmoid() * self.points.valid


class RigidMatch(nn.Module):
    """Two RGB-D frames -> objects, each with its mask and its rigid motion, by global matching."""

    def __init__(
        self, settings: RigidMatchSettings | None = None, *, generator: torch.Generator | None = None
    ) -> None:
        """Random weights.

        Args:
            settings: widths, depths and forms; the full size when None.
            generator: of the random numbers; torch's global one when None.
        """
        super().__init__()
        self.settings = settings = settings or RigidMatchSettings()
        self.encoder = Encoder(settings)
        self.position = Positions(5, settings.channels) if settings.attention_layers else None
        self.attention = FrameAttention(
            settings.channels, settings.heads, settings.attention_layers, settings.key_pool
        )
        self.matching = GlobalMatching(settings)
        self.refinement = Refinement(settings)
        self.dense_head = DenseHead(settings)
        self.decoder = SetDecoder(settings)
        self.moves = nn.Linear(settings.channels + 1, 1)
        if settings.xfeat in ("input", "both"):
            self.xfeat_input = nn.Conv2d(XFEAT_CHANNELS, settings.channels, 1)
        _initialise(self, generator)
        if settings.xfeat != "none":
            self.xfeat = XFeat(generator)

    def load_backbone(self, path: Path) -> None:
        """Take the frozen XFeat filters from a file of `scripts/convert_xfeat.py`.

        Raises:
            MethodError: a network without XFeat, or a file that does not fit.
        """
        if self.settings.xfeat == "none":
            raise MethodError(f"{path}: this rigidmatch has no XFeat backbone: set xfeat or leave the file out")
        self.xfeat.load(path)

    def forward(
        self,
        prev_color: Tensor,
        prev_points: Tensor,
        curr_color: Tensor,
        curr_points: Tensor,
        *,
        table: bool = True,
        min_probability: float | None = None,
        xfeat: Callable[[], Tensor] | None = None,
    ) -> RigidMatchOutput:
        """Predict objects and their motions from the current back to the previous frame.

        Args:
            prev_color, curr_color: (B, 3, H, W) RGB in 0..1.
            prev_points, curr_points: (B, 3, H, W) metres in the camera frame, NaN where depth is missing.
            table: return the table of all pairs' scores and the masks of every layer, which losses need; without it
                there is no gradient.
            min_probability: leave out queries that are objects with at most this probability in all pairs; None keeps
                all. Only without `table`.
            xfeat: returns (2 B, 64, h, w) of `self.xfeat` on `curr_color` and `prev_color`; called after the encoder.

        Returns:
            All predictions, on the grids of images padded to a multiple of the coarsest stride.
        """
        found = self.forward_features(
            prev_color,
            prev_points,
            curr_color,
            curr_points,
            table=table,
            min_probability=min_probability,
            xfeat=xfeat,
        )
        # 6. The motions that fit the matches.
        rotation, translation = self._motions(found)
        return RigidMatchOutput(
            scores=found.matched.scores,
            dustbin=found.matched.dustbin,
            rows=found.matched.rows,
            columns=found.matched.columns,
            coarse_match=found.coarse_points.points + found.matched.shift[:, 2:],
            match=found.refined.match,
            window_logits=found.refined.logits,
            window_center=found.refined.center,
            match_confidence=found.dense.match_confidence,
            foreground=found.dense.foreground,
            seed=found.dense.seed,
            votes=found.dense.votes,
            anchors=found.objects.anchors,
            objectness=found.objects.objectness,
            masks=found.objects.masks,
            moves=found.moves,
            rotation=rotation,
            translation=translation,
            upsampling=found.dense.upsampling,
            detail_queries=found.objects.detail_queries,
            details=found.dense.details,
        )

    def forward_features(
        self,
        prev_color: Tensor,
        prev_points: Tensor,
        curr_color: Tensor,
        curr_points: Tensor,
        *,
        table: bool = True,
        min_probability: float | None = None,
        xfeat: Callable[[], Tensor] | None = None,
    ) -> Features:
        """Everything but the motions; arguments as `forward`."""
        stride = self.settings.stride
        # 1. Both frames through one encoder, and through XFeat.
        described = [
            encode_inputs(*one, _STEP * stride) for one in ((curr_color, curr_points), (prev_color, prev_points))
        ]
        image, points, valid = (torch.cat(parts) for parts in zip(*described, strict=True))
        stem, fine, coarse = self.encoder(image)
        size = (coarse.shape[-2], coarse.shape[-1])
        coarse_grid, fine_grid = grid(points, valid, stride), grid(points, valid, stride // 2)
        curr, prev = _halves(coarse_grid)
        curr_fine, prev_fine = _halves(fine_grid)
        use, descriptors, fine_descriptors = self.settings.xfeat, None, None
        if use != "none":
            image_size = (curr_color.shape[-2], curr_color.shape[-1])
            features = self.xfeat(torch.cat([curr_color, prev_color])) if xfeat is None else xfeat()
            fine_descriptors = sample_cells(features, image_size, stride // 2, (2 * size[0], 2 * size[1]))
            if use in ("input", "both"):
                coarse = coarse + self.xfeat_input(fine_descriptors[..., ::2, ::2])
            if use in ("score", "both"):
                unit = F.normalize(fine_descriptors[..., ::2, ::2], dim=1)
                descriptors = unit.flatten(2).transpose(-2, -1)
        # 2. Attention within the frame and to the other frame.
        tokens = coarse.flatten(2).transpose(-2, -1)
        if self.position is not None:
            tokens = self.attention(tokens, self.position(_position_inputs(coarse_grid)), size)
        # 3. Global matching, then each match in a small window.
        matched = self.matching(tokens, curr, prev, descriptors, table=table)
        maps = as_map(tokens, size)
        refined = self.refinement(fine, maps, matched, curr_fine, prev_fine, fine_descriptors, blocks=not table)
        # 4. Dense predictions.
        current = [one.chunk(2)[0] for one in (stem, fine, maps)]
        dense = self.dense_head(*current, matched, refined, (curr, curr_fine))
        # 5. Objects.
        objects = self.decoder(dense, every_layer=table, min_probability=min_probability)
        shift = (objects.anchors[..., 3:] - objects.anchors[..., :3]).norm(dim=-1, keepdim=True)
        moves = self.moves(torch.cat([objects.queries, 10 * shift], dim=-1))[..., 0].float()
        return Features(curr, curr_fine, matched, refined, dense, objects, moves)

    def _motions(self, found: Features) -> tuple[Tensor, Tensor]:
        """(B, Q, 3, 3) rotations and (B, Q, 3) translations."""
        anchors = found.objects.anchors
        with torch.autocast(anchors.device.type, enabled=False):
            weights = found.weights().flatten(2)
            p, q = found.points.points.flatten(2).transpose(-2, -1), found.refined.match.flatten(2).transpose(-2, -1)
            R, t = solve_motions(weights, p, q, anchors, prior=PRIOR)
            for _ in range(self.settings.rounds):
                fits = agreement(R.detach(), t.detach(), p, q, _AGREE)
                R, t = solve_motions(weights * fits, p, q, anchors, prior=PRIOR)
        return R, t


def _position_inputs(points: Grid) -> Tensor:
    """(2 B, N, 5): each cell's point, and its position in an image that is a metre high."""
    height, width = points.points.shape[-2:]
    position = cells(height, width, points.points.device) / height
    both = torch.cat([points.points, position.expand(len(points.points), -1, -1, -1)], dim=1)
    return both.flatten(2).transpose(-2, -1)


def _halves(both: Grid) -> tuple[Grid, Grid]:
    (a, b), (c, d) = both.points.chunk(2), both.valid.chunk(2)
    return Grid(a, c), Grid(b, d)


def _initialise(network: nn.Module, generator: torch.Generator | None) -> None:
    """He et al. 2015 for filters before rectification, Glorot and Bengio 2010 for matrices; blocks as shortcuts."""
    if next(network.parameters()).is_meta:
        return  # there are no values, and drawing them on this device imports torch's compiler, which takes a second
    with torch.no_grad():
        for module in network.modules():
            if isinstance(module, nn.Conv2d):
                module.weight.normal_(0, math.sqrt(2 / module.weight[0].numel()), generator=generator)
            elif isinstance(module, nn.Linear):
                limit = math.sqrt(6 / (module.in_features + module.out_features))
                module.weight.uniform_(-limit, limit, generator=generator)
            if isinstance(module, nn.Conv2d | nn.Linear) and module.bias is not None:
                module.bias.zero_()
        for module in network.modules():
            if isinstance(module, Block):
                module.norm2.weight.zero_()
        _quiet(network)


_ZERO = ("decoder.shape", "decoder.detail_embedding", "matching.prior")


def _quiet(network: nn.Module) -> None:
    """Scale down layers whose output should start at, or near, zero."""
    for name, module in network.named_modules():
        last = name.rsplit(".", 1)[-1]
        if isinstance(module, nn.Linear) and (last == "out" or name in _ZERO):
            module.weight.zero_()
        elif name in ("dense_head.heads", "dense_head.guide", "dense_head.details.guide", "refinement.guide.2"):
            module.weight.mul_(0.1)
