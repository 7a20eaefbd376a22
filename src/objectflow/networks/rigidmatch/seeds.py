"""Query seeds: confident votes far apart, chosen greedily like the spheres of the paper."""

from __future__ import annotations

import torch
from torch import Tensor


@torch.no_grad()
def choose_seeds(votes: Tensor, confidence: Tensor, count: int, radius: float) -> Tensor:
    """Choose seeds greedily: repeatedly take the most confident vote and suppress the votes around it.

    Args:
        votes: (B, N, D) metres.
        confidence: (B, N), non-negative.
        count: number of seeds.
        radius: metres; a vote at distance d from a seed keeps 1 - exp(-d^2 / radius^2) of its confidence.

    Returns:
        (B, count) int64 indices into the N votes.
    """
    chosen = []
    for _ in range(count):
        best = confidence.argmax(dim=1, keepdim=True)
        chosen.append(best)
        center = votes.gather(1, best[..., None].expand(-1, -1, votes.shape[2]))
        confidence = confidence * (1 - torch.exp(-(votes - center).square().sum(-1) / radius**2))
    return torch.cat(chosen, dim=1)
