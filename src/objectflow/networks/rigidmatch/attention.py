"""Attention layers (Vaswani et al. 2017, pre-norm): within a frame, between frames, and from queries to tokens."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from objectflow.networks.rigidmatch.inputs import as_map

_WAVES = 6
"""Number of octaves per coordinate."""
_LONGEST = 4.0
"""Longest wavelength in metres; the shortest is 1/32 of it, 12.5 cm."""


class Positions(nn.Module):
    """Embedding of 3D points and image positions: sinusoids of each coordinate, then a linear layer."""

    def __init__(self, coordinates: int, channels: int) -> None:
        super().__init__()
        self.project = nn.Linear(coordinates * (2 * _WAVES + 1), channels)

    def forward(self, values: Tensor) -> Tensor:
        """(..., coordinates) in metres or image heights -> (..., channels)."""
        waves = 2 * math.pi / _LONGEST * 2.0 ** torch.arange(_WAVES, device=values.device, dtype=values.dtype)
        phase = (values[..., None] * waves).flatten(-2)
        out: Tensor = self.project(torch.cat([values, phase.sin(), phase.cos()], dim=-1))
        return out


class Attention(nn.Module):
    """Multi-head attention with a residual: x + attention(norm(x) + position, ...)."""

    def __init__(self, channels: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.norm = nn.LayerNorm(channels)
        self.query, self.key, self.value, self.out = (nn.Linear(channels, channels) for _ in range(4))

    def forward(self, x: Tensor, position: Tensor, keys: Tensor, values: Tensor, bias: Tensor | None = None) -> Tensor:
        """Attend from (B, N, C) to (B, M, C); `bias` (B, 1, N, M) is added to the logits."""
        parts = (self.query(self.norm(x) + position), self.key(keys), self.value(values))
        query, key, value = (part.reshape(*part.shape[:2], self.heads, -1).transpose(1, 2) for part in parts)
        found = F.scaled_dot_product_attention(query, key, value, attn_mask=None if bias is None else bias.to(query))
        out: Tensor = x + self.out(found.transpose(1, 2).flatten(2))
        return out


class FeedForward(nn.Module):
    """x + MLP(norm(x)) with one hidden layer of twice the width."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            nn.LayerNorm(channels), nn.Linear(channels, 2 * channels), nn.GELU(), nn.Linear(2 * channels, channels)
        )

    def forward(self, x: Tensor) -> Tensor:
        """(B, N, C) -> (B, N, C)."""
        out: Tensor = x + self.layers(x)
        return out


class FrameAttention(nn.Module):
    """Alternating self-attention and cross-attention layers (LoFTR, Sun et al. 2021)."""

    def __init__(self, channels: int, heads: int, layers: int, key_pool: int) -> None:
        super().__init__()
        self.key_pool = key_pool
        self.attentions = nn.ModuleList(Attention(channels, heads) for _ in range(layers))
        self.feeds = nn.ModuleList(FeedForward(channels) for _ in range(layers))
        self.norms = nn.ModuleList(nn.LayerNorm(channels) for _ in range(layers))

    def forward(self, tokens: Tensor, position: Tensor, size: tuple[int, int]) -> Tensor:
        """Apply the layers to (2 B, N, C) tokens, current frames first, with position embeddings; `size` is (h, w)."""
        for index, (attention, feed, norm) in enumerate(zip(self.attentions, self.feeds, self.norms, strict=True)):
            values = norm(tokens)
            keys = values + position
            if index % 2:
                keys, values = (torch.cat(tensor.chunk(2)[::-1]) for tensor in (keys, values))
            tokens = feed(attention(tokens, position, self._pool(keys, size), self._pool(values, size)))
        return tokens

    def _pool(self, tokens: Tensor, size: tuple[int, int]) -> Tensor:
        if self.key_pool == 1:
            return tokens
        pooled: Tensor = F.avg_pool2d(as_map(tokens, size), self.key_pool, ceil_mode=True).flatten(2).transpose(1, 2)
        return pooled
