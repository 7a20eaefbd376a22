"""The paper's training loss (section IV-C), each term by its name; no loop over objects.

What is summed over what: every pixel-wise term is the mean over a pair's foreground pixels (the mask's: over all
pixels), so large objects count for more, as in the paper's sums over pixels; L_var is the sum over a pair's objects of
their pixels' mean, as written. Both are averaged over the pairs of a batch, each pair counting the same, so that the
mean over machines equals the joint batch. The paper writes L_vio as a sum over pixels, and L_p without a sum; here
both are means over the same pixels: as a bare sum, over some ten thousand of them, L_vio would outweigh all else.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch
import torch.nn.functional as F
from torch import Tensor

from objectflow.dataset.targets import Targets
from objectflow.errors import MethodError
from objectflow.methods.sceneflownet.grouping import trajectory_feature
from objectflow.networks.sceneflownet.outputs import SceneFlowNetOutput, scene_flow
from objectflow.training.sceneflownet_match_loss import match_loss

_SLOTS = 256
"""Rows of any object table: labels are stored in 8 bits. A fixed number spares a GPU the wait for the true one."""
_FREE = 1 / 5
"""Of B: this near to the truth, a pixel's trajectory is no violation."""


@dataclass(frozen=True)
class SceneFlowNetLossSettings:
    """Weights of the terms, by their names in `sceneflownet_losses`, and their forms; the defaults are the paper's.

    Raises:
        MethodError: a weight that is negative or not finite.
    """

    mask: float = 1.0
    """L_m: cross entropy of foreground and background."""
    centrality: float = 1.0
    """L_center: cross entropy of eta, near the object's centroid or not. The paper names no value."""
    rotation: float = 0.1
    """Q, radians of axis-angle."""
    translation: float = 100.0
    """T, metres."""
    center: float = 10.0
    """X, metres."""
    flow: float = 10.0
    """S of equation 1, metres; its gradient reaches Q, T and X."""
    radius: float = 1.0
    """B, metres."""
    trajectory: float = 1.0
    """xi = [X, X + T], metres."""
    variance: float = 0.1
    """L_var: the spread of xi within an object."""
    violation: float = 0.1
    """L_vio: the way of xi to the truth, where it is further than B / 5."""
    vl: bool = True
    """With L_var and L_vio, the paper's +vL. Otherwise neither is computed."""
    squared: bool = False
    """Square the differences of Q, T, X, S, B and xi, as the authors' code does; their text says L2-norm."""
    match: float = 0.0
    """Not in the paper: cross entropy of the correlation over its patch, against the true match of each foreground
    cell. It tells colour features at once what they are for; without it they have to learn that
    through the max-pool and the hourglass."""
    rotation_weight: float = 0.0
    """Metres a radian: rotation joins xi with this weight. The grouping and the targets' B need the same value."""

    def __post_init__(self) -> None:
        for field in fields(self):
            # Written so that NaN fails too.
            if not 0 <= getattr(self, field.name) < float("inf"):
                raise MethodError(
                    f"loss setting {field.name} must be finite and >= 0, not {getattr(self, field.name)}"
                )


def sceneflownet_losses(
    output: SceneFlowNetOutput,
    targets: Targets,
    points: Tensor,
    settings: SceneFlowNetLossSettings | None = None,
    *,
    correlation: Tensor | None = None,
    matches: Tensor | None = None,
) -> dict[str, Tensor]:
    """Every term of the loss, and their weighted sum.

    All but the mask's look only at the truth's foreground, and the flow's only where there is a point. The terms are
    computed in float32, under autocast too. Rotations are compared as axis-angle vectors, as in the paper: near half
    a turn two vectors far apart may mean nearly the same rotation.

    Args:
        output: the network's maps.
        targets: from `make_targets`, with the same rotation weight.
        points: (B, 3, H, W) metres, the current frame's exact points; NaN or z <= 0 where depth is missing.
        settings: the paper's when None.
        correlation: from `SceneFlowNet.predict`, for the match term, which is left out without it.
        matches: (B, 2, H, W) from `previous_pixels`, likewise.

    Returns:
        Scalars without gradient, unweighted, named as the weights of `SceneFlowNetLossSettings` (without "variance"
        and "violation" where `vl` is off); and "total", weighted, with gradient. All are finite where no pixel is
        foreground.
    """
    settings = settings or SceneFlowNetLossSettings()
    with torch.autocast(points.device.type, enabled=False):
        output = SceneFlowNetOutput(*(one.float() for one in output))
        terms = _terms(output, targets, points.float(), settings)
        if settings.match > 0 and correlation is not None and matches is not None:
            terms["match"] = match_loss(correlation.float(), matches, targets.mask & (points[:, 2] > 0))
        total = torch.stack([getattr(settings, name) * term for name, term in terms.items()]).sum()
    return {**{name: term.detach() for name, term in terms.items()}, "total": total}


def _terms(
    output: SceneFlowNetOutput, targets: Targets, points: Tensor, settings: SceneFlowNetLossSettings
) -> dict[str, Tensor]:
    inside = targets.mask
    measured = torch.isfinite(points).all(dim=1) & (points[:, 2] > 0)
    # No NaN may enter, not even where its weight is 0: its gradient would be NaN.
    points = torch.where(measured[:, None], points, 0.0)
    flow = scene_flow(output.rotation, output.translation, output.center, points)
    weight = settings.rotation_weight
    off = trajectory_feature(
        output.center - targets.center,
        output.translation - targets.translation,
        output.rotation - targets.rotation,
        weight,
    )

    def pixelwise(difference: Tensor, where: Tensor) -> Tensor:
        return _mean_over(difference.square().sum(1) if settings.squared else _norm(difference), where)

    terms = {
        "mask": F.cross_entropy(output.mask, inside.long()),
        "centrality": _mean_over(F.cross_entropy(output.centrality, targets.eta.long(), reduction="none"), inside),
        "rotation": pixelwise(output.rotation - targets.rotation, inside),
        "translation": pixelwise(output.translation - targets.translation, inside),
        "center": pixelwise(output.center - targets.center, inside),
        "flow": pixelwise(flow - targets.flow, inside & measured),
        "radius": pixelwise(output.radius - targets.radius, inside),
        "trajectory": pixelwise(off, inside),
    }
    if settings.vl:
        # The truth is one value an object, so the spread of what is off is the spread of xi, with more digits.
        terms["variance"] = _spread_within(off, targets.index)
        distance = _norm(off)
        violating = inside & (distance.detach() > _FREE * targets.radius[:, 0])
        terms["violation"] = _mean_over(torch.where(violating, distance, 0.0), inside)
    return terms


def _norm(vectors: Tensor) -> Tensor:
    """(B, C, H, W) -> (B, H, W) lengths, with gradient 0 at 0; many times faster than `torch.linalg` over channels."""
    squared = vectors.square().sum(1)
    some = squared > 0
    return torch.where(some, torch.where(some, squared, 1.0).sqrt(), 0.0)


def _mean_over(values: Tensor, where: Tensor) -> Tensor:
    """Mean of (B, H, W) over a pair's pixels, then over the pairs; a pair without such pixels counts as 0."""
    weight = where.to(values.dtype)
    total = (values * weight).sum(dim=(1, 2))
    mean: Tensor = (total / weight.sum(dim=(1, 2)).clamp_min(1)).mean()
    return mean


def _spread_within(feature: Tensor, index: Tensor) -> Tensor:
    """L_var: the sum over objects of the mean squared distance to the object's own mean; mean over the pairs.

    (B, D, H, W) and the (B, H, W) row of each pixel's object, -1 for none.
    """
    inside = (index >= 0).flatten(1)
    slot = index.flatten(1).clamp_min(0)
    flat = feature.flatten(2)
    with torch.no_grad():
        count = flat.new_zeros(len(flat), _SLOTS).scatter_add_(1, slot, inside.to(flat.dtype))
        share = inside / count.gather(1, slot).clamp_min(1)
        wide = slot[:, None].expand_as(flat)
        mean = flat.new_zeros(*flat.shape[:2], _SLOTS).scatter_add_(2, wide, flat * share[:, None])
        # The mean needs no gradient: distances to it add up to 0 whichever way it moves.
        mean = mean.gather(2, wide)
    return ((flat - mean).square().sum(1) * share).sum(1).mean()
