"""Objects as a set: queries start at seeds, attend to tokens and predict masks (Cheng et al. 2022)."""

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
"""Initial radius in metres of an object's votes around its centre in trajectory space."""
_FARTHEST = 6.0
"""Distance in radii at which votes are truncated, so that single wrong votes cannot outweigh the embeddings."""


class Objects(NamedTuple):
    """Q queries.

    Attributes:
        queries: (B, Q, C) features.
        anchors: (B, Q, 6) metres: [X, X + T].
        objectness: (L, B, Q) logits.
        masks: (L, B, Q, H, W) logits; (1, B, Q, H, W) where only those of the last layer were wanted.
        detail_queries: (B, Q, D), for `pixel_masks`.
    """

    queries: Tensor
    anchors: Tensor
    objectness: Tensor
    masks: Tensor
    detail_queries: Tensor


class SetDecoder(nn.Module):
    """Seeds, then layers of attention to the tokens inside each query's current mask."""

    def __init__(self, settings: RigidMatchSettings) -> None:
        super().__init__()
        self.settings = settings
        channels, fine = settings.channels, settings.fine_channels
        layers = settings.decoder_layers
        self.seed_feature = nn.Conv2d(fine, channels, 1)
        if layers:
            self.position = Positions(6, channels)
            self.token_position = Positions(6, channels)
            self.token_norm = nn.LayerNorm(channels)
        self.across = nn.ModuleList(Attention(channels, settings.heads) for _ in range(layers))
        self.among = nn.ModuleList(Attention(channels, settings.heads) for _ in range(layers))
        self.feeds = nn.ModuleList(FeedForward(channels) for _ in range(layers))
        self.norm = nn.LayerNorm(channels)
        self.objectness = nn.Linear(channels, 1)
        # Weight of the votes, their radius, and the bias of the mask.
        self.shape = nn.Linear(channels, 3)
        self.mask_embedding = nn.Sequential(nn.Linear(channels, channels), nn.GELU(), nn.Linear(channels, fine))
        self.pixel_embedding = nn.Conv2d(fine, fine, 1)
        self.detail_embedding = nn.Linear(channels, settings.detail_channels) if settings.detail_channels else None

    def forward(
        self, dense: DensePredictions, *, every_layer: bool = True, min_probability: float | None = None
    ) -> Objects:
        """Find the objects of dense predictions.

        Args:
            dense: of the current frame.
            every_layer: return the masks of every layer, which losses need; otherwise those of the last layer alone,
                and earlier ones are computed on the coarse grid only.
            min_probability: leave out queries that are objects with at most this probability in all pairs, before
                their masks are computed; None keeps all. It needs `every_layer` to be false.
        """
        size = dense.votes.shape[-2:]
        with torch.autocast(dense.votes.device.type, enabled=False):
            votes = dense.votes.float().flatten(2).transpose(-2, -1)
            coarse_votes = dense.votes[..., ::2, ::2].float()
            confidence = (dense.seed.sigmoid() * dense.foreground.sigmoid())[:, 0, ::2, ::2].float()
            coarse_flat = coarse_votes.flatten(2).transpose(-2, -1)
            index = choose_seeds(
                coarse_flat.detach(), confidence.flatten(1), self.settings.queries, self.settings.seed_radius
            )
        anchors = _at(coarse_flat, index)
        queries = _at(self.seed_feature(dense.pixels)[..., ::2, ::2].flatten(2).transpose(-2, -1), index)
        embeddings = self.pixel_embedding(dense.pixels).flatten(2)
        if len(self.across):
            tokens = self.token_norm(dense.tokens.flatten(2).transpose(-2, -1))
            # A token's position: its vote for the object's centre in both frames.
            keys = tokens + self.token_position(coarse_flat.detach())
            coarse_embeddings = embeddings.reshape(*embeddings.shape[:2], *size)[..., ::2, ::2].flatten(2)
        objectness, masks = [], []
        for index_layer in range(len(self.across) + 1):
            normed = self.norm(queries)
            objectness.append(self.objectness(normed)[..., 0].float())
            is_last = index_layer == len(self.across)
            if is_last and min_probability is not None:
                likely = (objectness[-1].sigmoid() > min_probability).any(0)
                normed, anchors = normed[:, likely], anchors[:, likely]
                objectness = [one[:, likely] for one in objectness]
            if every_layer or is_last:
                masks.append(self._mask(normed, anchors, votes, embeddings).reshape(*normed.shape[:2], *size))
            if is_last:
                break
            # Masked attention (Cheng et al. 2022), made soft: little weight outside of the current mask.
            if every_layer:
                coarse_mask = masks[-1][..., ::2, ::2].flatten(2).detach()
            else:
                coarse_mask = self._mask(normed, anchors, coarse_flat, coarse_embeddings)
            bias = F.logsigmoid(coarse_mask).clamp_min(-8.0)[:, None]
            position = self.position(anchors.detach())
            queries = self.across[index_layer](queries, position, keys, tokens, bias)
            values = self.norm(queries)
            queries = self.among[index_layer](queries, position, values + position, values)
            queries = self.feeds[index_layer](queries)
            # One step of mean shift: the mean vote of the mask is more stable than the seed's.
            anchors = _mean_votes(coarse_mask.sigmoid(), coarse_flat, anchors)
        if self.detail_embedding is None:
            details = normed.new_zeros(*normed.shape[:2], 0).float()
        else:
            details = self.detail_embedding(normed).float()
        return Objects(normed, anchors, torch.stack(objectness), torch.stack(masks), details)

    def _mask(self, queries: Tensor, anchors: Tensor, votes: Tensor, embeddings: Tensor) -> Tensor:
        """(B, Q, N) logits: distance of votes in trajectory space, and similarity of embeddings."""
        with torch.autocast(queries.device.type, enabled=False):
            strength, radius, bias = self.shape(queries.float()).unbind(-1)
            # Float64, since the root of the rounding error at distance 0 would be 1 mm.
            far, near = votes.double(), anchors.double()
            square = (
                far.square().sum(-1)[:, None] + near.square().sum(-1)[..., None] - 2 * near @ far.transpose(-2, -1)
            ).float()
            distance = (square.clamp_min(0) + 1e-6).sqrt() / (_RADIUS * radius.clamp(-2, 2).exp())[..., None]
            out: Tensor = (
                3 * strength.clamp(-2, 2).exp()[..., None] * (1 - distance.clamp(max=_FARTHEST)) + bias[..., None]
            )
        similarity: Tensor = self.mask_embedding(queries) @ embeddings / math.sqrt(embeddings.shape[1])
        return out + similarity.float()


def _at(values: Tensor, index: Tensor) -> Tensor:
    """(B, N, C) at (B, Q) -> (B, Q, C)."""
    return values.gather(1, index[..., None].expand(-1, -1, values.shape[2]))


def _mean_votes(weights: Tensor, votes: Tensor, anchors: Tensor) -> Tensor:
    """(B, Q, 6) means of votes (B, N, 6) under weights (B, Q, N); the previous anchor counts as one vote."""
    # bfloat16 is too coarse for metres.
    with torch.autocast(votes.device.type, enabled=False):
        return (weights.float() @ votes + anchors) / (weights.float().sum(-1, keepdim=True) + 1)
