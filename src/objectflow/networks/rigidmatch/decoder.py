"""Objects as a set: queries that start at seeds, look at tokens in turn, and say their masks (Cheng et al. 2022)."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from objectflow.networks.rigidmatch.attention import Attention, FeedForward, Positions
from objectflow.networks.rigidmatch.dense_head import DensePredictions
from objectflow.networks.rigidmatch.seeds import choose_seeds
from objectflow.networks.rigidmatch.settings import RigidMatchSettings

_RADIUS = 0.04
"""Metres in trajectory space: how far an object's votes lie from its centre, at first."""
_FARTHEST = 6.0
"""Radii beyond which a vote is no farther: single wrong votes must not decide against all looks."""


class Objects(NamedTuple):
    """Q queries.

    Attributes:
        queries: (B, Q, C) features.
        anchors: (B, Q, 6) metres: [X, X + T].
        objectness: (L, B, Q) logits.
        masks: (L, B, Q, H, W) logits.
    """

    queries: Tensor
    anchors: Tensor
    objectness: Tensor
    masks: Tensor


class SetDecoder(nn.Module):
    """Seeds, layers of attention to tokens inside the mask so far, and the masks that follow."""

    def __init__(self, settings: RigidMatchSettings) -> None:
        super().__init__()
        self.settings = settings
        channels, fine = settings.channels, settings.fine_channels
        self.queries_mode = settings.objects == "queries"
        layers = settings.decoder_layers if self.queries_mode else 0
        self.seed_feature = nn.Conv2d(fine, channels, 1)
        if layers:
            self.place = Positions(6, channels)
            self.token_place = Positions(6, channels)
            self.token_norm = nn.LayerNorm(channels)
        self.across = nn.ModuleList(Attention(channels, settings.heads) for _ in range(layers))
        self.among = nn.ModuleList(Attention(channels, settings.heads) for _ in range(layers))
        self.feeds = nn.ModuleList(FeedForward(channels) for _ in range(layers))
        self.norm = nn.LayerNorm(channels)
        self.objectness = nn.Linear(channels, 1)
        # How much votes count, how far they may lie, and what is needed to belong.
        self.shape = nn.Linear(channels, 3)
        if self.queries_mode:
            self.look = nn.Sequential(nn.Linear(channels, channels), nn.GELU(), nn.Linear(channels, fine))
            self.pixel_look = nn.Conv2d(fine, fine, 1)

    def forward(self, scene: DensePredictions) -> Objects:
        """Find the objects of a scene."""
        size = scene.votes.shape[-2:]
        with torch.autocast(scene.votes.device.type, enabled=False):
            votes = scene.votes.float().flatten(2).transpose(-2, -1)
            coarse_votes = scene.votes[..., ::2, ::2].float()
            sure = (scene.seed.sigmoid() * scene.foreground.sigmoid())[:, 0, ::2, ::2].float()
            coarse_flat = coarse_votes.flatten(2).transpose(-2, -1)
            index = choose_seeds(
                coarse_flat.detach(), sure.flatten(1), self.settings.queries, self.settings.seed_radius
            )
        anchors = _at(coarse_flat, index)
        queries = _at(self.seed_feature(scene.pixels)[..., ::2, ::2].flatten(2).transpose(-2, -1), index)
        looks = self.pixel_look(scene.pixels).flatten(2) if self.queries_mode else None
        if len(self.across):
            tokens = self.token_norm(scene.tokens.flatten(2).transpose(-2, -1))
            # Where a token's object lies, and where it was.
            keys = tokens + self.token_place(coarse_flat.detach())
        objectness, masks = [], []
        for index_layer in range(len(self.across) + 1):
            normed = self.norm(queries)
            objectness.append(self.objectness(normed)[..., 0].float())
            mask = self._mask(normed, anchors, votes, looks).reshape(*queries.shape[:2], *size)
            masks.append(mask)
            if index_layer == len(self.across):
                break
            # Outside of its mask so far a query sees little (Cheng et al. 2022, masked attention, made soft).
            coarse_mask = mask[..., ::2, ::2].flatten(2).detach()
            bias = F.logsigmoid(coarse_mask).clamp_min(-8.0)[:, None]
            place = self.place(anchors.detach())
            queries = self.across[index_layer](queries, place, keys, tokens, bias)
            values = self.norm(queries)
            queries = self.among[index_layer](queries, place, values + place, values)
            queries = self.feeds[index_layer](queries)
            # One step of mean shift: the mask's mean vote is steadier than the seed's.
            anchors = _mean_votes(coarse_mask.sigmoid(), coarse_flat, anchors)
        return Objects(self.norm(queries), anchors, torch.stack(objectness), torch.stack(masks))

    def _mask(self, queries: Tensor, anchors: Tensor, votes: Tensor, looks: Tensor | None) -> Tensor:
        """(B, Q, N) logits: nearness of votes in trajectory space, and likeness of looks."""
        with torch.autocast(queries.device.type, enabled=False):
            strength, radius, bias = self.shape(queries.float()).unbind(-1)
            # In float64: a seed is at a distance of 0 from itself, and the root of what rounding left would be 1 mm.
            far, near = votes.double(), anchors.double()
            square = (
                far.square().sum(-1)[:, None] + near.square().sum(-1)[..., None] - 2 * near @ far.transpose(-2, -1)
            ).float()
            distance = (square.clamp_min(0) + 1e-6).sqrt() / (_RADIUS * radius.clamp(-2, 2).exp())[..., None]
            out: Tensor = (
                3 * strength.clamp(-2, 2).exp()[..., None] * (1 - distance.clamp(max=_FARTHEST)) + bias[..., None]
            )
        if looks is None:
            return out
        like: Tensor = self.look(queries) @ looks / math.sqrt(looks.shape[1])
        return out + like.float()


def _at(values: Tensor, index: Tensor) -> Tensor:
    """(B, N, C) at (B, Q) -> (B, Q, C)."""
    return values.gather(1, index[..., None].expand(-1, -1, values.shape[2]))


def _mean_votes(weights: Tensor, votes: Tensor, anchors: Tensor) -> Tensor:
    """(B, Q, 6): means of votes (B, N, 6) under weights (B, Q, N), the anchor before counting as one vote."""
    # Metres have too few digits in bfloat16.
    with torch.autocast(votes.device.type, enabled=False):
        return (weights.float() @ votes + anchors) / (weights.float().sum(-1, keepdim=True) + 1)
