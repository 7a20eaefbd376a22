"""Grouping of dense maps into labels by greedy spheres in trajectory space (section III-B of the paper)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from objectflow.errors import MethodError

_COMPACT = 0.8
"""Maximum share of unassigned pixels, 0..1, at which assigned pixels are removed from the arrays."""
DIRECT_PIXELS = 1024
"""Maximum number of unassigned pixels whose mutual distances are computed at once, in one or two megabytes."""


@dataclass(frozen=True)
class GroupingSettings:
    """Settings of `group`.

    Raises:
        MethodError: `rotation_weight` is negative or not finite, or `min_pixels` or `max_seeds` is below 1.
    """

    rotation_weight: float = 0.0
    """Weight of rotation in the trajectory feature, in metres per radian. 0 is the paper's method; a positive weight,
    proposed in its discussion, separates objects that share a path but differ in rotation."""
    min_pixels: int = 20
    """Minimum number of pixels of an object; pixels of smaller groups join the nearest object."""
    max_seeds: int = 1000
    """Maximum number of spheres, which bounds the run time on noise; the remaining pixels join the nearest object."""

    def __post_init__(self) -> None:
        # The comparison is written so that NaN fails too.
        if not 0 <= self.rotation_weight < float("inf"):
            raise MethodError(f"grouping setting rotation_weight must be finite and >= 0, not {self.rotation_weight}")
        if self.min_pixels < 1 or self.max_seeds < 1:
            raise MethodError("grouping settings min_pixels and max_seeds must be at least 1")


def trajectory_feature(center: Tensor, translation: Tensor, rotation: Tensor, rotation_weight: float = 0.0) -> Tensor:
    """Compute the feature that pixels of one object share: xi = [X, X + T], optionally with the weighted rotation.

    Args:
        center, translation: (..., 3, H, W) metres.
        rotation: (..., 3, H, W) axis-angle in radians.
        rotation_weight: metres per radian; 0 omits the rotation.

    Returns:
        (..., 6, H, W) metres, or (..., 9, H, W).
    """
    parts = [center, center + translation]
    if rotation_weight > 0:
        parts.append(rotation_weight * rotation)
    return torch.cat(parts, dim=-3)


def group(
    feature: Tensor, foreground: Tensor, centrality: Tensor, radius: Tensor, settings: GroupingSettings | None = None
) -> Tensor:
    """Assign foreground pixels to objects, one sphere at a time.

    The seed is the unassigned foreground pixel with the largest eta (the first in row-major order among equals). Every
    unassigned foreground pixel joins it if the distance of their features is below the seed's B. This repeats; then
    the pixels of groups below `min_pixels` join the object with the nearest mean feature. No gradient is computed.

    Args:
        feature: (D, H, W) metres, from `trajectory_feature`; D is usually 6 or 9.
        foreground: (H, W) bool. Pixels whose feature, eta or B is not finite are ignored.
        centrality: (H, W) eta; only its order matters, so a difference of logits suffices.
        radius: (H, W) metres, B.
        settings: the defaults if None.

    Returns:
        (H, W) int32 on the maps' device: 0 = background, 1..K in the order of the seeds. All 0 if no group has
        `min_pixels`.

    Raises:
        MethodError: the sizes of the maps differ, or the foreground is not bool.
    """
    settings = settings or GroupingSettings()
    size = foreground.shape
    if feature.ndim != 3 or {feature.shape[1:], centrality.shape, radius.shape} != {size}:
        shapes = ", ".join(str(tuple(values.shape)) for values in (feature, foreground, centrality, radius))
        raise MethodError(f"grouping needs maps (D, H, W), (H, W), (H, W), (H, W) of one size, not {shapes}")
    if foreground.dtype != torch.bool:
        raise MethodError(f"grouping needs a bool foreground, not {foreground.dtype}: compare the logits first")
    with torch.no_grad():
        usable = foreground & feature.isfinite().all(dim=0) & centrality.isfinite() & radius.isfinite()
        pixels = usable.flatten().nonzero()[:, 0]
        # In descending order of eta, the next seed is always the first unassigned pixel.
        order = centrality.flatten()[pixels].argsort(descending=True, stable=True)
        pixels = pixels[order]
        points = feature.flatten(1)[:, pixels]
        groups = _spheres(points, radius.flatten()[pixels], settings.max_seeds)
        labels = torch.zeros(usable.numel(), dtype=torch.int32, device=usable.device)
        labels[pixels] = _join_leftovers(points, groups, settings.min_pixels)
    return labels.reshape(size)


def _spheres(points: Tensor, radius: Tensor, max_seeds: int) -> Tensor:
    """Greedy spheres: (D, N) and (N,) in the order of seeds -> (N,) int64 groups from 1; 0 = unassigned."""
    groups = torch.zeros(points.shape[1], dtype=torch.int64, device=points.device)
    place = torch.arange(points.shape[1], device=points.device)
    # Without the clamp, the square of a negative B would be a positive radius.
    reach = radius.clamp_min(0).square()
    left, free, first = points, torch.ones_like(groups, dtype=torch.bool), 0
    for seed in range(1, max_seeds + 1):
        if place.numel() <= DIRECT_PIXELS:
            place, left = place[free], left[:, free]
            groups[place] = _few_spheres(left, reach[place], seed, max_seeds)
            break
        inside = _squared_distance(left, left[:, first : first + 1]) < reach[place[first]]
        inside &= free
        inside[first] = True  # even if its radius is 0, since the loop would not end otherwise
        groups[place[inside]] = seed
        free &= ~inside
        if int(free.sum()) <= _COMPACT * free.numel():
            left, place = left[:, free], place[free]
            free = torch.ones_like(place, dtype=torch.bool)
            first = 0
        else:
            first = int(free.to(torch.uint8).argmax())
    return groups


def _few_spheres(points: Tensor, reach: Tensor, seed: int, max_seeds: int) -> Tensor:
    """Apply the rule of `_spheres` with all distances computed at once, which is faster for many small spheres.

    (D, M), (M,) squared radii and the number of the next group -> (M,) int64 groups; 0 = unassigned.
    """
    distance = _squared_distance(points[:, None, :], points[:, :, None])
    near = (distance < reach[:, None]).cpu().numpy()
    groups = np.zeros(len(near), np.int64)
    free = np.ones(len(near), np.bool_)
    for first in range(len(near)):
        if seed > max_seeds:
            break
        if free[first]:
            inside = near[first] & free
            inside[first] = True
            groups[inside] = seed
            free ^= inside
            seed += 1
    return torch.from_numpy(groups).to(points.device)


def _squared_distance(points: Tensor, center: Tensor) -> Tensor:
    """(D, ...) and (D, ...), broadcast -> (...); summed axis by axis to avoid a (D, ...) temporary."""
    out = (points[0] - center[0]).square_()
    for axis in range(1, points.shape[0]):
        difference = points[axis] - center[axis]
        out.addcmul_(difference, difference)
    return out


def _join_leftovers(points: Tensor, groups: Tensor, min_pixels: int) -> Tensor:
    """(D, N) and (N,) groups -> (N,) int32 labels 1..K of the large groups; other pixels join the nearest."""
    counts = groups.bincount(minlength=1)
    large = counts >= min_pixels
    large[0] = False  # unassigned pixels
    if not bool(large.any()):
        return torch.zeros_like(groups, dtype=torch.int32)
    number = torch.where(large, large.cumsum(0), 0)
    labels = number[groups]
    leftover = (labels == 0).nonzero()[:, 0]
    if leftover.numel():
        sums = points.new_zeros((points.shape[0], counts.numel()), dtype=torch.float64)
        sums.index_add_(1, groups, points.double())
        means = (sums[:, large] / counts[large]).to(points.dtype)
        strays = points[:, leftover]
        best = torch.full_like(strays[0], torch.inf)
        for label in range(1, means.shape[1] + 1):
            distance = _squared_distance(strays, means[:, label - 1 : label])
            closer = distance < best
            labels[leftover[closer]] = label
            best = torch.minimum(best, distance)
    return labels.to(torch.int32)
