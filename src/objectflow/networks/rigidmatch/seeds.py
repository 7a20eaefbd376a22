"""Where queries start: at votes that are sure and apart from each other, as the paper's spheres are chosen."""

from __future__ import annotations

import torch
from torch import Tensor


@torch.no_grad()
def choose_seeds(votes: Tensor, sure: Tensor, count: int, radius: float) -> Tensor:
    """Greedily: the surest vote, which makes those around it unsure; then the next.

    Args:
        votes: (B, N, D) metres.
        sure: (B, N) from 0 up.
        count: how many.
        radius: metres at which a vote loses 63% of its sureness: 1 - exp(-d^2 / radius^2) is left.

    Returns:
        (B, count) int64: their places among the N.
    """
    chosen = []
    for _ in range(count):
        best = sure.argmax(dim=1, keepdim=True)
        chosen.append(best)
        center = votes.gather(1, best[..., None].expand(-1, -1, votes.shape[2]))
        sure = sure * (1 - torch.exp(-(votes - center).square().sum(-1) / radius**2))
    return torch.cat(chosen, dim=1)
