"""The losses of `RigidMatch`, each term by its name: matches, votes, the set of objects, and flow after the solve."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from objectflow.networks.rigidmatch.outputs import RigidMatchOutput, upsampled_masks
from objectflow.training.hungarian import AREA_OFFSET, assign_queries, mask_costs
from objectflow.training.rigidmatch_loss_settings import RigidMatchLossSettings
from objectflow.training.rigidmatch_targets import Cells, RigidMatchTargets, make_rigidmatch_targets
from objectflow.training.step import Prepared

_CORRECT = 0.02
"""Largest error in metres of a match that counts as correct."""
_EXCLUDED = -1e3
"""Scores below this belong to cells that are excluded from matching."""
_SEED_DECAY = 0.06
"""Error in metres at which a vote's target value as a seed has fallen to 1 / e."""


def rigidmatch_losses(
    output: RigidMatchOutput, prepared: Prepared, stride: int, settings: RigidMatchLossSettings | None = None
) -> dict[str, Tensor]:
    """Every term of the loss, and their weighted sum.

    Means over cells are over the whole batch; object terms are means over the batch's objects.

    Args:
        output: of the network.
        prepared: from `prepare`.
        stride: of the network's coarse grid, pixels.
        settings: the defaults when None.

    Returns:
        Scalars without gradient, unweighted, named as the weights; and "total", weighted, with gradient.
    """
    settings = settings or RigidMatchLossSettings()
    with torch.autocast(prepared.points.device.type, enabled=False):
        truth = make_rigidmatch_targets(prepared, stride, settings.background)
        output = cropped(output, truth)
        terms = {
            "match": match_term(output, truth),
            "window": window_term(output, truth),
            "position": position_term(output, truth),
            "match_confidence": match_confidence_term(output, truth),
        } | vote_terms(output, truth)
        terms |= object_terms(output, truth, prepared, settings)
        total = torch.stack([getattr(settings, name) * term for name, term in terms.items()]).sum()
    return {**{name: term.detach() for name, term in terms.items()}, "total": total}


def cropped(output: RigidMatchOutput, truth: RigidMatchTargets) -> RigidMatchOutput:
    """The output without the cells beyond the image's edge, except for `scores` and the fields that belong to it."""
    height, width = truth.owner.shape[-2:]
    dense = ("match", "window_logits", "window_center", "match_confidence", "foreground", "seed", "votes", "masks")
    changes = {name: getattr(output, name)[..., :height, :width] for name in dense}
    details = output.details[..., : 2 * height, : 2 * width]
    return output._replace(**changes, upsampling=output.upsampling[..., :height, :width], details=details)


def match_term(output: RigidMatchOutput, truth: RigidMatchTargets) -> Tensor:
    """-log of the true cell's probability over rows and over columns, or of the dustbin; the mean over cells."""
    height, width = output.coarse_match.shape[-2:]
    index, share = _padded(truth.coarse.cell, truth.coarse, height, width), truth.coarse.share
    share, weight, occluded = (
        F.pad(image, (0, width - image.shape[-1], 0, height - image.shape[-2]))
        for image in (share, truth.coarse_weight, truth.coarse.occluded)
    )
    at, part = index.flatten(2).mT, share.flatten(2).mT
    scores = output.scores.gather(2, at)
    part = part * (scores > _EXCLUDED)  # cells without depth cannot be a match
    found = (part * (2 * scores - output.rows[..., None] - output.columns.gather(1, at.flatten(1)).view_as(at))).sum(2)
    known = part.sum(2) > 0
    lost = occluded.flatten(1)
    # A match has two terms; the dustbin has one, since it has no column.
    total = -torch.where(known, 0.5 * found, torch.where(lost, output.dustbin - output.rows, 0.0))
    return _mean(total, weight.flatten(1) * (known | lost))


def _padded(index: Tensor, cells: Cells, height: int, width: int) -> Tensor:
    """Indices into the image's own cells as indices into a grid with `width` columns, padded to (height, width)."""
    own = cells.seen.shape[-1]
    moved = index // own * width + index % own
    return F.pad(moved, (0, width - index.shape[-1], 0, height - index.shape[-2]))


def window_term(output: RigidMatchOutput, truth: RigidMatchTargets) -> Tensor:
    """-log of the true cell's probability in the last window; the mean over cells whose match lies in it."""
    logits = output.window_logits
    if not logits.shape[1]:
        return logits.sum()
    side = round(logits.shape[1] ** 0.5)
    width = truth.owner.shape[-1]
    cells = truth.fine
    row = cells.cell // width - output.window_center[:, 1:] + side // 2
    column = cells.cell % width - output.window_center[:, :1] + side // 2
    inside = (row >= 0) & (row < side) & (column >= 0) & (column < side)
    share = cells.share * inside
    logs = F.log_softmax(logits, dim=1).gather(1, (row * side + column).clamp(0, side * side - 1))
    known = share.sum(1) > 0.5
    return _mean(-(share * logs).sum(1) / share.sum(1).clamp_min(0.5), truth.fine_weight * known)


def position_term(output: RigidMatchOutput, truth: RigidMatchTargets) -> Tensor:
    """Metres from the expected to the true position, if visible in the previous frame; the mean of both grids."""
    height, width = truth.coarse_weight.shape[-2:]
    coarse = _length(output.coarse_match[..., :height, :width] - truth.coarse_position)
    fine = _length(output.match - truth.fine_position)
    return 0.5 * (
        _mean(coarse, truth.coarse_weight * truth.coarse.seen) + _mean(fine, truth.fine_weight * truth.fine.seen)
    )


def match_confidence_term(output: RigidMatchOutput, truth: RigidMatchTargets) -> Tensor:
    """Cross entropy of "this match is within 2 cm of the truth"."""
    error = _length(output.match.detach() - truth.fine_position)
    correct = ((error < _CORRECT) & truth.fine.seen).float()
    entropy = F.binary_cross_entropy_with_logits(output.match_confidence[:, 0], correct, reduction="none")
    return _mean(entropy, truth.fine_weight)


def vote_terms(output: RigidMatchOutput, truth: RigidMatchTargets) -> dict[str, Tensor]:
    """Foreground over all cells, errors of the votes on objects, and the votes' values as seeds."""
    inside = (truth.owner >= 0).float()
    error = _length(output.votes[:, :3] - truth.votes[:, :3]) + _length(output.votes[:, 3:] - truth.votes[:, 3:])
    seed_target = inside * torch.exp(-error.detach() / _SEED_DECAY)
    entropy = F.binary_cross_entropy_with_logits
    return {
        "foreground": entropy(output.foreground[:, 0], inside),
        "votes": _mean(error, inside),
        "seed": entropy(output.seed[:, 0], seed_target),
    }


def object_terms(
    output: RigidMatchOutput, truth: RigidMatchTargets, prepared: Prepared, settings: RigidMatchLossSettings
) -> dict[str, Tensor]:
    """The terms of queries and objects, after the assignment in every decoder layer."""
    masks = truth.masks.flatten(2)
    present = masks.sum(2) > 0
    costs = mask_costs(output.masks.flatten(3), masks)
    total = settings.mask * costs.cross_entropy + settings.dice * costs.dice
    query = assign_queries(total - settings.objectness * output.objectness.sigmoid()[..., None], present)
    found = query >= 0
    # Rows without an object read the values of an arbitrary query, with weight 0.
    at = query.clamp_min(0)
    taken = torch.zeros_like(output.objectness).scatter_add_(2, at, found.to(output.objectness.dtype)) > 0
    weight = torch.where(taken, 1.0, settings.no_object)
    entropy = F.binary_cross_entropy_with_logits(output.objectness, taken.float(), reduction="none")
    terms = {
        "objectness": _mean(entropy, weight),
        "mask": _mean(_of(costs.cross_entropy, at), found),
        "dice": _mean(_of(costs.dice, at), found),
    }
    last, kept = at[-1], found[-1]
    terms["pixels"] = pixel_term(output, prepared, last, kept)
    both = kept & truth.in_both
    terms["flow"] = flow_term(output, truth, last, both)
    logits = output.moves.gather(1, last)
    moving = F.binary_cross_entropy_with_logits(logits, truth.moving.float(), reduction="none")
    return terms | {"moving": _mean(moving, both)}


def _of(costs: Tensor, query: Tensor) -> Tensor:
    """(L, B, Q, K) costs at the queries (L, B, K) -> (L, B, K)."""
    return costs.gather(2, query[:, :, None])[:, :, 0]


def pixel_term(output: RigidMatchOutput, prepared: Prepared, query: Tensor, kept: Tensor) -> Tensor:
    """Cross entropy and dice of the matched masks on the finest grid."""
    # Each pair's matched objects first, and no column that is empty in all pairs.
    most = max(1, int(kept.sum(1).max()))
    rows = (~kept).to(torch.uint8).argsort(dim=1, stable=True)[:, :most]
    query, kept = query.gather(1, rows), kept.gather(1, rows)
    chosen = output.masks[-1].gather(1, query[..., None, None].expand(-1, -1, *output.masks.shape[-2:]))
    queries = output.detail_queries.gather(1, query[..., None].expand(-1, -1, output.detail_queries.shape[-1]))
    logits = upsampled_masks(chosen, output.upsampling, queries, output.details)
    step = 1 if not queries.shape[-1] else 2
    index = prepared.targets.index[:, ::step, ::step]
    logits = logits[..., : index.shape[-2], : index.shape[-1]].flatten(2)
    true = (index[:, None] == rows[..., None, None]).flatten(2).to(logits.dtype)
    area, inside = true.sum(2), logits.sigmoid()
    entropy = (F.softplus(logits) - logits * true).sum(2) / (area + AREA_OFFSET * logits.shape[2])
    dice = 1 - (2 * (inside * true).sum(2) + 1) / (inside.sum(2) + area + 1)
    return _mean(entropy + dice, kept)


def flow_term(output: RigidMatchOutput, truth: RigidMatchTargets, query: Tensor, kept: Tensor) -> Tensor:
    """Metres between the flow of each matched query's motion and the true flow: the mean of the objects' means."""
    batch, K = query.shape
    owner = truth.owner.clamp_min(0).flatten(1)
    own_query = query.gather(1, owner)
    R = output.rotation.flatten(2).gather(1, own_query[..., None].expand(-1, -1, 9)).reshape(batch, -1, 3, 3)
    t = output.translation.gather(1, own_query[..., None].expand(-1, -1, 3))
    points, position = truth.points.flatten(2).mT, truth.fine_position.flatten(2).mT
    error = ((R @ points[..., None])[..., 0] + t - position).square().sum(-1).clamp_min(1e-12).sqrt()
    counted = ((truth.owner >= 0) & truth.measured).flatten(1).float()
    zeros = error.new_zeros(batch, K)
    sums = zeros.scatter_add(1, owner, error * counted)
    counts = zeros.scatter_add(1, owner, counted)
    return _mean(sums / counts.clamp_min(1), kept & (counts > 0))


def _length(vectors: Tensor) -> Tensor:
    """Lengths of (B, 3, H, W) vectors as (B, H, W), with a finite gradient at 0."""
    return vectors.square().sum(1).clamp_min(1e-12).sqrt()


def _mean(values: Tensor, weights: Tensor) -> Tensor:
    """The weighted mean; 0 if all weights are 0."""
    weights = weights.to(values.dtype)
    return (values * weights).sum() / weights.sum().clamp_min(1e-6)
