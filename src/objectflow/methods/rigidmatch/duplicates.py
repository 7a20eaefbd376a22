"""Queries that found the same object, merged into one mask with their joint probability."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

MAX_LOGIT = 8.0
"""Absolute value at which mask logits are truncated before they are averaged: no query outweighs the others."""


class MergedMasks(NamedTuple):
    """M objects out of K queries, in the order of their most probable queries.

    Attributes:
        logits: (M, H, W) mask logits: the mean of the queries' logits, weighted by their probabilities.
        probability: (M,) of an object: that at least one of its queries is right.
        best: (M,) int64 index of each object's most probable query.
    """

    logits: Tensor
    probability: Tensor
    best: Tensor


def merge_duplicates(logits: Tensor, probability: Tensor, min_iou: float) -> MergedMasks:
    """Merge the masks that overlap the mask of a more probable query.

    Training assigns one query to each object, so several queries on one object share its probability: each may be
    below a threshold that the object passes, and their masks differ at the edges. From the most probable query on,
    each query takes the remaining ones whose masks overlap its own.

    Args:
        logits: (K, H, W) mask logits, of pixels or of cells.
        probability: (K,) object probability.
        min_iou: minimum intersection over union, 0..1, of two masks of one object.
    """
    if not len(probability):
        return MergedMasks(logits, probability, torch.zeros(0, dtype=torch.long, device=logits.device))
    inside = (logits > 0).flatten(1).float()
    common = inside @ inside.T
    area = inside.sum(1)
    union = area[:, None] + area[None] - common
    same = (common > min_iou * union).cpu().numpy()
    order = probability.argsort(descending=True, stable=True).cpu().numpy()
    left = set(order.tolist())
    groups = []
    for first in order.tolist():
        if first in left:
            group = [first, *(k for k in order.tolist() if k in left and k != first and same[first, k])]
            left.difference_update(group)
            groups.append(group)
    groups.sort(key=lambda group: group[0])  # not by probability, so that rounding does not change the order
    weights = torch.zeros(len(groups), len(probability), device=logits.device)
    for place, group in enumerate(groups):
        weights[place, group] = probability[group].float() / probability[group].float().sum()
    merged = logits.float().clamp(-MAX_LOGIT, MAX_LOGIT).flatten(1)
    mean = (weights @ merged).reshape(len(groups), *logits.shape[1:])
    joint = torch.stack([1 - (1 - probability[group].float()).prod() for group in groups])
    return MergedMasks(mean, joint, torch.tensor([group[0] for group in groups], device=logits.device))
