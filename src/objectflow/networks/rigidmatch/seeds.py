"""Seeds of queries: confident votes that lie apart from each other, chosen as the paper's spheres are."""

from __future__ import annotations

import torch
from torch import Tensor


@torch.no_grad()
def choose_seeds(votes: Tensor, confidence: Tensor, count: int, radius: float) -> Tensor:
    """Choose seeds greedily: the most confident vote, which suppresses those around it, then the next.

    Args:
        votes: (B, N, D) metres.
        confidence: (B, N), not negative.
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
