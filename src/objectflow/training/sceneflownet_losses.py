"""The paper's training loss (section IV-C), each term by its name, without a loop over objects.

Every pixel-wise term is the mean over a pair's foreground pixels (the mask's: over all pixels), so large objects have
more weight, as in the paper's sums over pixels. L_var is the sum over a pair's objects of the mean over their pixels,
as in the paper. All terms are then averaged over the pairs of a batch with equal weights, so that the mean over
machines equals the loss of the joint batch. The paper writes L_vio as a sum over pixels and L_p without a sum; here
both are means over the same pixels, since a sum over some ten thousand pixels would outweigh all other terms.
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

_MAX_OBJECTS = 256
"""Maximum number of rows of an object table (labels have 8 bits); a constant avoids a GPU synchronisation."""
_TOLERANCE = 1 / 5
"""Largest distance to the true trajectory, relative to B, that is not a violation."""


@dataclass(frozen=True)
class SceneFlowNetLossSettings:
    """Weights of the terms, by their names in `sceneflownet_losses`, and their form; the defaults are the paper's.

    Raises:
        MethodError: a weight that is negative or not finite.
    """

    mask: float = 1.0
    """L_m: cross entropy of foreground and background."""
    centrality: float = 1.0
    """L_center: cross entropy of eta, near the object's centroid or not. The paper gives no value."""
    rotation: float = 0.1
    """Error of Q, radians of axis-angle."""
    translation: float = 100.0
    """Error of T, metres."""
    center: float = 10.0
    """Error of X, metres."""
    flow: float = 10.0
    """Error of S of equation 1, metres; its gradient reaches Q, T and X."""
    radius: float = 1.0
    """Error of B, metres."""
    trajectory: float = 1.0
    """Error of xi = [X, X + T], metres."""
    variance: float = 0.1
    """L_var: the variance of xi within an object."""
    violation: float = 0.1
    """L_vio: the error of xi where it exceeds B / 5."""
    vl: bool = True
    """Include L_var and L_vio, the paper's +vL."""
    squared: bool = False
    """Square the errors of Q, T, X, S, B and xi, as the authors' code does; their text says L2-norm."""
    match: float = 0.0
    """Not in the paper: cross entropy of the correlation over its patch, against the true match of each foreground
    cell. It trains the colour features directly instead of through the max-pool and the hourglass."""
    rotation_weight: float = 0.0
    """Metres per radian of rotation in xi. Targets and grouping use the same value."""

    def __post_init__(self) -> None:
        for field in fields(self):
            if not 0 <= getattr(self, field.name) < float("inf"):  # NaN fails this comparison too
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

    All terms except the mask's are restricted to the true foreground, and the flow's to pixels with depth. The terms
    are computed in float32, also under autocast. Rotations are compared as axis-angle vectors, as in the paper: near
    half a turn, distant vectors may represent nearly the same rotation.

    Args:
        output: the network's maps.
        targets: from `make_targets`, with the same rotation weight.
        points: (B, 3, H, W) metres, the current frame's exact points; NaN or z <= 0 where depth is missing.
        settings: the paper's when None.
        correlation: from `SceneFlowNet.predict`, for the match term, which is omitted without it.
        matches: (B, 2, H, W) from `previous_pixels`, for the match term.

    Returns:
        Scalars without gradient, unweighted, named as the weights of `SceneFlowNetLossSettings` (without "variance"
        and "violation" if `vl` is off); and "total", weighted, with gradient. All are finite even without foreground
        pixels.
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
    # NaN must not enter even with weight 0, since its gradient would be NaN.
    points = torch.where(measured[:, None], points, 0.0)
    flow = scene_flow(output.rotation, output.translation, output.center, points)
    weight = settings.rotation_weight
    error = trajectory_feature(
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
        "trajectory": pixelwise(error, inside),
    }
    if settings.vl:
        # The truth is constant within an object, so the error has the variance of xi, with more significant digits.
        terms["variance"] = _variance_within(error, targets.index)
        distance = _norm(error)
        violating = inside & (distance.detach() > _TOLERANCE * targets.radius[:, 0])
        terms["violation"] = _mean_over(torch.where(violating, distance, 0.0), inside)
    return terms


def _norm(vectors: Tensor) -> Tensor:
    """Lengths of (B, C, H, W) as (B, H, W), with gradient 0 at 0; much faster than `torch.linalg` over channels."""
    squared = vectors.square().sum(1)
    nonzero = squared > 0
    return torch.where(nonzero, torch.where(nonzero, squared, 1.0).sqrt(), 0.0)


def _mean_over(values: Tensor, where: Tensor) -> Tensor:
    """Mean of (B, H, W) over a pair's pixels, then over the pairs; a pair without such pixels contributes 0."""
    weight = where.to(values.dtype)
    total = (values * weight).sum(dim=(1, 2))
    mean: Tensor = (total / weight.sum(dim=(1, 2)).clamp_min(1)).mean()
    return mean


def _variance_within(feature: Tensor, index: Tensor) -> Tensor:
    """L_var: the sum over objects of the mean squared distance to the object's mean; averaged over the pairs.

    Args:
        feature: (B, D, H, W).
        index: (B, H, W) row of each pixel's object, -1 for none.
    """
    inside = (index >= 0).flatten(1)
    slot = index.flatten(1).clamp_min(0)
    flat = feature.flatten(2)
    with torch.no_grad():
        count = flat.new_zeros(len(flat), _MAX_OBJECTS).scatter_add_(1, slot, inside.to(flat.dtype))
        share = inside / count.gather(1, slot).clamp_min(1)
        wide = slot[:, None].expand_as(flat)
        mean = flat.new_zeros(*flat.shape[:2], _MAX_OBJECTS).scatter_add_(2, wide, flat * share[:, None])
        # The mean needs no gradient, since the distances to it sum to 0.
        mean = mean.gather(2, wide)
    return ((flat - mean).square().sum(1) * share).sum(1).mean()
