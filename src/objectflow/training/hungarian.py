"""Assignment of queries to objects: costs of all pairs, and the cheapest one-to-one matching (Carion et al. 2020)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from scipy.optimize import linear_sum_assignment
from torch import Tensor

AREA_OFFSET = 1 / 32
"""Share of the image that is added to an object's area before its mask's cross entropy is divided by it. Without the
division, small objects would hardly count; without the offset, tiny ones would dominate."""


class MaskCosts(NamedTuple):
    """(..., Q, K) costs of every query's mask for every object, with gradient."""

    cross_entropy: Tensor
    dice: Tensor


def mask_costs(logits: Tensor, masks: Tensor) -> MaskCosts:
    """Cross entropy and dice (Milletari et al. 2016) of all pairs, as matrix products.

    Args:
        logits: (L, B, Q, N).
        masks: (B, K, N), 0 or 1.
    """
    area = masks.sum(-1)[:, None]
    inside = logits.sigmoid()
    cross_entropy = (F.softplus(logits).sum(-1)[..., None] - logits @ masks.mT) / (
        area + AREA_OFFSET * logits.shape[-1]
    )
    dice = 1 - (2 * inside @ masks.mT + 1) / (inside.sum(-1)[..., None] + area + 1)
    return MaskCosts(cross_entropy, dice)


@torch.no_grad()
def assign_queries(costs: Tensor, present: Tensor) -> Tensor:
    """The cheapest one-to-one assignment of queries to objects (Kuhn 1955).

    Args:
        costs: (L, B, Q, K).
        present: (B, K) bool: rows that hold an object. If there are more objects than queries, the ones that cost
            most stay unassigned.

    Returns:
        (L, B, K) int64: each object's query, -1 if unassigned.
    """
    table = np.nan_to_num(costs.detach().double().cpu().numpy(), nan=1e6, posinf=1e6, neginf=-1e6)
    mask = present.cpu().numpy()
    out = np.full((table.shape[0], table.shape[1], table.shape[3]), -1, np.int64)
    for layer in range(table.shape[0]):
        for b in range(table.shape[1]):
            objects = np.nonzero(mask[b])[0]
            queries, columns = linear_sum_assignment(table[layer, b][:, objects])
            out[layer, b, objects[columns]] = queries
    return torch.from_numpy(out).to(costs.device)
