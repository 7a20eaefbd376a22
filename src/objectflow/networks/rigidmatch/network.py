"""The network: encode, attend, match, refine, vote, find objects, solve their motions."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from objectflow.networks.rigidmatch.attention import FrameAttention, Positions
from objectflow.networks.rigidmatch.decoder import Objects, SetDecoder
from objectflow.networks.rigidmatch.encoder import Block, Encoder
from objectflow.networks.rigidmatch.inputs import Grid, as_map, cells, describe, grid
from objectflow.networks.rigidmatch.matching import GlobalMatching
from objectflow.networks.rigidmatch.motion import agreement, solve_motions
from objectflow.networks.rigidmatch.outputs import RigidOutput
from objectflow.networks.rigidmatch.refinement import FineMatch, Refinement
from objectflow.networks.rigidmatch.scene import Scene, SceneHead
from objectflow.networks.rigidmatch.settings import RigidMatchSettings
from objectflow.torch_geometry import so3_exp

_PRIOR = 1.0
"""Matches that the votes' own motion counts for in the solve."""
_AGREE = 0.02
"""Metres: a match so far from its object's motion weighs half."""
_STEP = 2
"""The context grid's cells in the coarse grid's."""


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
        self.place = Positions(5, settings.channels)
        self.attention = FrameAttention(
            settings.channels, settings.heads, settings.attention_layers, settings.key_pool
        )
        self.matching = GlobalMatching(settings)
        self.refinement = Refinement(settings)
        self.scene = SceneHead(settings)
        self.decoder = SetDecoder(settings)
        self.moves = nn.Linear(settings.channels + 1, 1)
        if settings.motion == "regress":
            width = settings.channels
            self.regress = nn.Sequential(nn.Linear(width, width), nn.GELU(), nn.Linear(width, 6))
        _initialise(self, generator)

    def forward(self, prev_color: Tensor, prev_points: Tensor, curr_color: Tensor, curr_points: Tensor) -> RigidOutput:
        """Predict objects and their motions from the current back to the previous frame.

        Args:
            prev_color, curr_color: (B, 3, H, W) RGB in 0..1.
            prev_points, curr_points: (B, 3, H, W) metres in the camera frame, NaN where depth is missing.

        Returns:
            Everything on grids of images padded to multiples of the coarsest stride; see `objects_at` for masks.
        """
        stride = self.settings.stride
        # 1. Both frames through one encoder.
        described = [describe(*one, _STEP * stride) for one in ((curr_color, curr_points), (prev_color, prev_points))]
        image, points, valid = (torch.cat(parts) for parts in zip(*described, strict=True))
        fine, coarse = self.encoder(image)
        coarse_grid, fine_grid = grid(points, valid, stride), grid(points, valid, stride // 2)
        curr, prev = _halves(coarse_grid)
        curr_fine, prev_fine = _halves(fine_grid)
        # 2. Every cell learns of its own frame and of the other.
        size = (coarse.shape[-2], coarse.shape[-1])
        tokens = self.attention(coarse.flatten(2).mT, self._place(coarse_grid), size)
        # 3. Everything is matched with everything; then each match in a small window.
        matched = self.matching(tokens, curr, prev)
        maps = as_map(tokens, size)
        refined = self.refinement(fine, maps, matched, curr_fine, prev_fine)
        # 4. What that means, cell by cell.
        scene = self.scene(fine.chunk(2)[0], maps.chunk(2)[0], matched, refined, (curr, curr_fine))
        # 5. Objects, and their motions.
        objects = self.decoder(scene)
        rotation, translation = self._motions(objects, scene, refined, curr_fine)
        shift = (objects.anchors[..., 3:] - objects.anchors[..., :3]).norm(dim=-1, keepdim=True)
        return RigidOutput(
            scores=matched.scores,
            hidden=matched.hidden,
            rows=matched.rows,
            columns=matched.columns,
            coarse_match=curr.points + matched.shift[:, 2:],
            match=refined.match,
            window_logits=refined.logits,
            window_center=refined.center,
            reliability=scene.reliability,
            foreground=scene.foreground,
            seed=scene.seed,
            votes=scene.votes,
            anchors=objects.anchors,
            objectness=objects.objectness,
            masks=objects.masks,
            moves=self.moves(torch.cat([objects.queries, 10 * shift], dim=-1))[..., 0].float(),
            rotation=rotation,
            translation=translation,
            upsampling=scene.upsampling,
        )

    def _place(self, points: Grid) -> Tensor:
        """(2 B, N, C) of each cell's point and place in the image, a metre high."""
        height, width = points.points.shape[-2:]
        place = cells(height, width, points.points.device) / height
        both = torch.cat([points.points, place.expand(len(points.points), -1, -1, -1)], dim=1)
        out: Tensor = self.place(both.flatten(2).mT)
        return out

    def _motions(self, objects: Objects, scene: Scene, match: FineMatch, curr: Grid) -> tuple[Tensor, Tensor]:
        X, Y = objects.anchors[..., :3], objects.anchors[..., 3:]
        if self.settings.motion == "regress":
            found = 0.1 * self.regress(objects.queries).float()
            R = so3_exp(10 * found[..., :3])
            return R, Y + found[..., 3:] - (R @ X[..., None])[..., 0]
        with torch.autocast(curr.points.device.type, enabled=False):
            trust = scene.reliability.sigmoid() * curr.valid
            weights = objects.masks[-1].flatten(2).sigmoid() * trust.flatten(2)
            p, q = curr.points.flatten(2).mT, match.match.flatten(2).mT
            R, t = solve_motions(weights, p, q, objects.anchors, prior=_PRIOR)
            for _ in range(self.settings.rounds):
                fits = agreement(R.detach(), t.detach(), p, q, _AGREE)
                R, t = solve_motions(weights * fits, p, q, objects.anchors, prior=_PRIOR)
        return R, t


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
