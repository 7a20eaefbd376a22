"""The network: encode, attend, match, refine, vote, find objects, solve their motions."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn

from objectflow.geometry.torch_se3 import so3_exp
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

PRIOR = 1.0
"""Matches that the votes' own motion counts for in the solve."""
_AGREE = 0.02
"""Metres: a match so far from its object's motion weighs half."""
_STEP = 2
"""The context grid's cells in the coarse grid's."""


class Features(NamedTuple):
    """What is known before motions are solved.

    Attributes:
        coarse_points, points: of the current frame's grids.
        matched, refined: the matches of both.
        scene: what they mean.
        objects: Q queries.
        moves: (B, Q) logits.
    """

    coarse_points: Grid
    points: Grid
    matched: CoarseMatch
    refined: FineMatch
    scene: DensePredictions
    objects: Objects
    moves: Tensor

    def weights(self) -> Tensor:
        """(B, Q, H, W): of each fine cell's match in each object's solve: mask times trust, 0 without depth."""
        trust = self.scene.reliability.sigmoid() * self.points.valid
        return self.objects.masks[-1].sigmoid() * trust


class RigidMatch(nn.Module):
    """Two RGB-D frames -> objects, each with its mask and its rigid motion, by matching everything with everything."""

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
        self.place = Positions(5, settings.channels) if settings.attention_layers else None
        self.attention = FrameAttention(
            settings.channels, settings.heads, settings.attention_layers, settings.key_pool
        )
        self.matching = GlobalMatching(settings)
        self.refinement = Refinement(settings)
        self.scene = DenseHead(settings)
        self.decoder = SetDecoder(settings)
        self.moves = nn.Linear(settings.channels + 1, 1)
        if settings.motion == "regress":
            width = settings.channels
            self.regress = nn.Sequential(nn.Linear(width, width), nn.GELU(), nn.Linear(width, 6))
        _initialise(self, generator)

    def forward(
        self,
        prev_color: Tensor,
        prev_points: Tensor,
        curr_color: Tensor,
        curr_points: Tensor,
        *,
        table: bool = True,
    ) -> RigidMatchOutput:
        """Predict objects and their motions from the current back to the previous frame.

        Args:
            prev_color, curr_color: (B, 3, H, W) RGB in 0..1.
            prev_points, curr_points: (B, 3, H, W) metres in the camera frame, NaN where depth is missing.
            table: give the table of all pairs' scores, which losses need; without it there is no gradient.

        Returns:
            Everything, on the grids of images padded to a multiple of the coarsest stride.
        """
        found = self.look(prev_color, prev_points, curr_color, curr_points, table=table)
        # 6. The motions that fit the matches.
        rotation, translation = self._motions(found)
        return RigidMatchOutput(
            scores=found.matched.scores,
            hidden=found.matched.hidden,
            rows=found.matched.rows,
            columns=found.matched.columns,
            coarse_match=found.coarse_points.points + found.matched.shift[:, 2:],
            match=found.refined.match,
            window_logits=found.refined.logits,
            window_center=found.refined.center,
            reliability=found.scene.reliability,
            foreground=found.scene.foreground,
            seed=found.scene.seed,
            votes=found.scene.votes,
            anchors=found.objects.anchors,
            objectness=found.objects.objectness,
            masks=found.objects.masks,
            moves=found.moves,
            rotation=rotation,
            translation=translation,
            upsampling=found.scene.upsampling,
        )

    def look(
        self,
        prev_color: Tensor,
        prev_points: Tensor,
        curr_color: Tensor,
        curr_points: Tensor,
        *,
        table: bool = True,
    ) -> Features:
        """Everything but the motions; arguments as `forward`."""
        stride = self.settings.stride
        # 1. Both frames through one encoder.
        described = [
            encode_inputs(*one, _STEP * stride) for one in ((curr_color, curr_points), (prev_color, prev_points))
        ]
        image, points, valid = (torch.cat(parts) for parts in zip(*described, strict=True))
        fine, coarse = self.encoder(image)
        coarse_grid, fine_grid = grid(points, valid, stride), grid(points, valid, stride // 2)
        curr, prev = _halves(coarse_grid)
        curr_fine, prev_fine = _halves(fine_grid)
        # 2. Every cell learns of its own frame and of the other.
        size = (coarse.shape[-2], coarse.shape[-1])
        tokens = coarse.flatten(2).transpose(-2, -1)
        if self.place is not None:
            tokens = self.attention(tokens, self.place(_where(coarse_grid)), size)
        # 3. Everything is matched with everything; then each match in a small window.
        matched = self.matching(tokens, curr, prev, table=table)
        maps = as_map(tokens, size)
        refined = self.refinement(fine, maps, matched, curr_fine, prev_fine)
        # 4. What that means, cell by cell.
        scene = self.scene(fine.chunk(2)[0], maps.chunk(2)[0], matched, refined, (curr, curr_fine))
        # 5. Objects.
        objects = self.decoder(scene)
        shift = (objects.anchors[..., 3:] - objects.anchors[..., :3]).norm(dim=-1, keepdim=True)
        moves = self.moves(torch.cat([objects.queries, 10 * shift], dim=-1))[..., 0].float()
        return Features(curr, curr_fine, matched, refined, scene, objects, moves)

    def _motions(self, found: Features) -> tuple[Tensor, Tensor]:
        """(B, Q, 3, 3) rotations and (B, Q, 3) translations."""
        anchors = found.objects.anchors
        if self.settings.motion == "regress":
            X, Y = anchors[..., :3], anchors[..., 3:]
            change = self.regress(found.objects.queries).float()
            R = so3_exp(change[..., :3])
            return R, Y + 0.1 * change[..., 3:] - (R @ X[..., None])[..., 0]
        with torch.autocast(anchors.device.type, enabled=False):
            weights = found.weights().flatten(2)
            p, q = found.points.points.flatten(2).transpose(-2, -1), found.refined.match.flatten(2).transpose(-2, -1)
            R, t = solve_motions(weights, p, q, anchors, prior=PRIOR)
            for _ in range(self.settings.rounds):
                fits = agreement(R.detach(), t.detach(), p, q, _AGREE)
                R, t = solve_motions(weights * fits, p, q, anchors, prior=PRIOR)
        return R, t


def _where(points: Grid) -> Tensor:
    """(2 B, N, 5): each cell's point, and its place in an image that is a metre high."""
    height, width = points.points.shape[-2:]
    place = cells(height, width, points.points.device) / height
    both = torch.cat([points.points, place.expand(len(points.points), -1, -1, -1)], dim=1)
    return both.flatten(2).transpose(-2, -1)


def _halves(both: Grid) -> tuple[Grid, Grid]:
    (a, b), (c, d) = both.points.chunk(2), both.valid.chunk(2)
    return Grid(a, c), Grid(b, d)


def _initialise(network: nn.Module, generator: torch.Generator | None) -> None:
    """He et al. 2015 for filters before rectification, Glorot and Bengio 2010 for matrices; blocks as shortcuts."""
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


def _quiet(network: nn.Module) -> None:
    """Layers that start at, or near, saying nothing."""
    for name, module in network.named_modules():
        last = name.rsplit(".", 1)[-1]
        if isinstance(module, nn.Linear) and (last == "out" or name in ("decoder.shape", "matching.prior")):
            module.weight.zero_()
        elif name in ("scene.heads", "scene.guide", "refinement.guide.2"):
            module.weight.mul_(0.1)
        elif name == "regress.2":
            module.weight.zero_()
