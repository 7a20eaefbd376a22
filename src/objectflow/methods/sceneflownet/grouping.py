"""Dense maps -> labels: the paper's greedy spheres in trajectory space (section III-B)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from objectflow.errors import MethodError

_COMPACT = 0.8
"""Assigned pixels are dropped from the arrays once no more than this share of them is left unassigned."""
DIRECT_PIXELS = 1024
"""Number of unassigned pixels at which all mutual distances are computed at once, in one or two megabytes."""


@dataclass(frozen=True)
class GroupingSettings:
    """How pixels become objects.

    Raises:
        MethodError: a negative number, or no seed at all.
    """

    rotation_weight: float = 0.0
    """Metres a radian: rotation joins the trajectory feature with this weight. 0 is the paper's method; its discussion
    proposes the other, which tells objects on one path apart that turn differently."""
    min_pixels: int = 20
    """Groups of fewer pixels are leftovers and join the nearest object."""
    max_seeds: int = 1000
    """What is unassigned after so many spheres is leftover too: keeps noise from taking for ever."""

    def __post_init__(self) -> None:
        # Written so that NaN fails too.
        if not 0 <= self.rotation_weight < float("inf"):
            raise MethodError(f"grouping setting rotation_weight must be finite and >= 0, not {self.rotation_weight}")
        if self.min_pixels < 1 or self.max_seeds < 1:
            raise MethodError("grouping settings min_pixels and max_seeds must be at least 1")


def trajectory_feature(center: Tensor, translation: Tensor, rotation: Tensor, rotation_weight: float = 0.0) -> Tensor:
    """What pixels of one object share: xi = [X, X + T], and with a weight also the rotation.

    Args:
        center, translation: (..., 3, H, W) metres.
        rotation: (..., 3, H, W) axis-angle in radians.
        rotation_weight: metres a radian; 0 leaves rotation out.

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
    """Assign foreground pixels to objects, one sphere after the other.

    The unassigned foreground pixel of the largest eta is the seed (the first in reading order among equals); every
    unassigned foreground pixel whose feature lies closer to the seed's than the seed's B joins it; repeat. Groups of
    fewer than `min_pixels` then join the object whose mean feature is nearest. The maps are read without gradient.

    Args:
        feature: (D, H, W) metres, from `trajectory_feature`; D is 6 or 9 but may be anything.
        foreground: (H, W) bool. Pixels whose feature, eta or B is not finite are left out of it.
        centrality: (H, W) eta; only its order counts, so a difference of logits does.
        radius: (H, W) metres, B.
        settings: the defaults when None.

    Returns:
        (H, W) int32 on the maps' device: 0 = background, 1..K in the order of the seeds. All 0 where no group is large
        enough to be an object.

    Raises:
        MethodError: maps of different sizes, or a foreground that is not bool.
    """
    settings = settings or GroupingSettings()
    size = foreground.shape
    if feature.ndim != 3 or {feature.shape[1:], centrality.shape, radius.shape} != {size}:
        shapes = ", ".join(str(tuple(one.shape)) for one in (feature, foreground, centrality, radius))
        raise MethodError(f"grouping needs maps (D, H, W), (H, W), (H, W), (H, W) of one size, not {shapes}")
    if foreground.dtype != torch.bool:
        raise MethodError(f"grouping needs a bool foreground, not {foreground.dtype}: compare the logits first")
    with torch.no_grad():
        usable = foreground & feature.isfinite().all(dim=0) & centrality.isfinite() & radius.isfinite()
        pixels = usable.flatten().nonzero()[:, 0]
        # By falling eta, the next seed is always the first pixel that is left.
        order = centrality.flatten()[pixels].argsort(descending=True, stable=True)
        pixels = pixels[order]
        points = feature.flatten(1)[:, pixels]
        groups = _spheres(points, radius.flatten()[pixels], settings.max_seeds)
        labels = torch.zeros(usable.numel(), dtype=torch.int32, device=usable.device)
        labels[pixels] = _join_leftovers(points, groups, settings.min_pixels)
    return labels.reshape(size)


def _spheres(points: Tensor, radius: Tensor, max_seeds: int) -> Tensor:
    """The greedy spheres: (D, N) and (N,) in the seeds' order -> (N,) int64 groups from 1; 0 = not reached."""
    groups = torch.zeros(points.shape[1], dtype=torch.int64, device=points.device)
    place = torch.arange(points.shape[1], device=points.device)
    # The square of B keeps a B below 0 from reaching anywhere.
    reach = radius.clamp_min(0).square()
    left, free, first = points, torch.ones_like(groups, dtype=torch.bool), 0
    for seed in range(1, max_seeds + 1):
        if place.numel() <= DIRECT_PIXELS:
            place, left = place[free], left[:, free]
            groups[place] = _few_spheres(left, reach[place], seed, max_seeds)
            break
        inside = _squared_distance(left, left[:, first : first + 1]) < reach[place[first]]
        inside &= free
        inside[first] = True  # whatever its radius, or the loop would not end
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
    """The same rule with all distances found at once, which starts the many spheres of strays faster.

    (D, M), (M,) squared radii and the number of the next group -> (M,) int64 groups; 0 = not reached.
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
    """(D, ...) and (D, ...) that broadcast -> (...), axis by axis: no array as large as the points is made."""
    out = (points[0] - center[0]).square_()
    for axis in range(1, points.shape[0]):
        difference = points[axis] - center[axis]
        out.addcmul_(difference, difference)
    return out


def _join_leftovers(points: Tensor, groups: Tensor, min_pixels: int) -> Tensor:
    """(D, N) and (N,) groups -> (N,) int32 labels 1..K of the large groups; other pixels join the nearest."""
    counts = groups.bincount(minlength=1)
    large = counts >= min_pixels
    large[0] = False  # pixels that no sphere reached
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
