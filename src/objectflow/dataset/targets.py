"""Dense training targets of a batch, computed on its device from object tables and label images.

Data sets store no dense maps: rotation, translation, centre, flow, radius and centrality of every pixel follow from a
few numbers per object (paper, section III).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from objectflow.errors import DatasetError
from objectflow.geometry.torch_se3 import so3_exp

CENTER_PIXELS = 300
"""D of the paper: number of pixels per object, nearest to its centre, whose centrality is 1."""
RADIUS_ALONE = 0.5
"""Metres: radius B of an object without any other object in the image."""


@dataclass(frozen=True, eq=False)
class ObjectTable:
    """The objects of a batch of pairs, padded to a common number K.

    Attributes:
        label: (B, K) int64; 0 = padding.
        center, translation, rotation: (B, K, 3) float32: X and T in metres, R as axis-angle in radians.
        in_both: (B, K) bool: visible in both frames.
    """

    label: Tensor
    center: Tensor
    translation: Tensor
    rotation: Tensor
    in_both: Tensor

    def to(self, device: torch.device | str) -> ObjectTable:
        """The table on another device."""
        moved = (getattr(self, name).to(device, non_blocking=True) for name in self.__dataclass_fields__)
        return ObjectTable(*moved)


@dataclass(frozen=True, eq=False)
class Targets:
    """The target of each pixel of the current frame; 0 on the background.

    Attributes:
        mask: (B, H, W) bool: pixels of objects.
        seen: (B, H, W) bool: pixels of objects visible in both frames, to which the paper's masked metrics apply.
        index: (B, H, W) int64: the object's row in the object table, -1 on the background.
        rotation, translation, center: (B, 3, H, W) Q in radians, T and X in metres.
        flow: (B, 3, H, W) metres, equation 1; 0 where depth is missing. See `with_camera` for the background's flow
            of a moving camera.
        radius: (B, 1, H, W) metres, B.
        eta: (B, H, W) bool: the pixels nearest to the centre of each object.
    """

    mask: Tensor
    seen: Tensor
    index: Tensor
    rotation: Tensor
    translation: Tensor
    center: Tensor
    flow: Tensor
    radius: Tensor
    eta: Tensor


def make_targets(
    table: ObjectTable, labels: Tensor, points: Tensor, *, nearest: int = CENTER_PIXELS, rotation_weight: float = 0.0
) -> Targets:
    """Targets of a batch.

    Args:
        table: the objects, on the device of the images.
        labels: (B, H, W) integer label image of the current frame.
        points: (B, 3, H, W) metres, of the current frame; NaN or z <= 0 where depth is missing.
        nearest: number of pixels per object that are marked as its centre.
        rotation_weight: metres per radian of rotation in the trajectories that determine B; 0 as in the paper.

    Raises:
        DatasetError: shapes that do not fit, or a label that the table lacks.
    """
    if labels.ndim != 3 or points.shape != (labels.shape[0], 3, *labels.shape[1:]):
        raise DatasetError(
            f"targets need (B, H, W) labels and (B, 3, H, W) points, not {labels.shape}, {points.shape}"
        )
    if table.label.shape[0] != labels.shape[0]:
        raise DatasetError(f"the object table has {table.label.shape[0]} rows, the batch {labels.shape[0]}")
    index = _rows_of(table, labels)
    mask = index >= 0
    measured = torch.isfinite(points[:, 2]) & (points[:, 2] > 0)
    safe_points = torch.where(measured[:, None], points, torch.zeros_like(points))
    rotation, translation, center = (
        _spread(values, index) for values in (table.rotation, table.translation, table.center)
    )
    nine = _spread(so3_exp(table.rotation).flatten(2), index)
    matrices = nine.reshape(nine.shape[0], 3, 3, *nine.shape[2:])
    offset = safe_points - center
    flow = torch.einsum("bijhw,bjhw->bihw", matrices, offset) + center + translation - safe_points
    flow = torch.where((mask & measured)[:, None], flow, torch.zeros_like(flow))
    return Targets(
        mask=mask,
        seen=_spread(table.in_both[..., None].float(), index)[:, 0] > 0,
        index=index,
        rotation=rotation,
        translation=translation,
        center=center,
        flow=flow,
        radius=_spread(_radii(table, rotation_weight)[..., None], index),
        eta=_nearest_to_center(offset.square().sum(1), index, measured, table.label.shape[1], nearest),
    )


def with_camera(targets: Targets, points: Tensor, camera_motion: Tensor | None) -> Targets:
    """Targets whose background flow is that of the camera motion.

    Args:
        targets: of a batch.
        points: (B, 3, H, W) metres, as passed to `make_targets`.
        camera_motion: (B, 4, 4) `prev_T_curr` of the static background; None for a static camera.
    """
    if camera_motion is None:
        return targets
    safe = torch.where((points[:, 2:] > 0) & torch.isfinite(points[:, 2:]), points, torch.zeros_like(points))
    moved = torch.einsum("bij,bjhw->bihw", camera_motion[:, :3, :3], safe) + camera_motion[:, :3, 3, None, None]
    background = ~targets.mask & (safe[:, 2] > 0)
    return replace(targets, flow=torch.where(background[:, None], moved - safe, targets.flow))


def _rows_of(table: ObjectTable, labels: Tensor) -> Tensor:
    """(B, H, W) row of each pixel's object in the table, -1 on the background."""
    top = int(torch.maximum(labels.max(), table.label.max())) + 1
    lookup = torch.full((labels.shape[0], top), -2, dtype=torch.int64, device=labels.device)
    rows = torch.arange(table.label.shape[1], device=labels.device).expand_as(table.label)
    lookup.scatter_(1, table.label, rows)
    lookup[:, 0] = -1  # padding also has label 0
    index = lookup.gather(1, labels.flatten(1).long()).view(labels.shape)
    if bool((index == -2).any()):
        raise DatasetError("a label image holds a label that its object table lacks: check the data set")
    return index


def _spread(values: Tensor, index: Tensor) -> Tensor:
    """(B, K, C) per object -> (B, C, H, W) per pixel; 0 on the background."""
    batch, _, channels = values.shape
    flat = index.flatten(1).clamp(min=0)[..., None].expand(-1, -1, channels)
    dense = values.gather(1, flat) * (index.flatten(1) >= 0)[..., None]
    return dense.transpose(1, 2).reshape(batch, channels, *index.shape[1:])


def _radii(table: ObjectTable, rotation_weight: float) -> Tensor:
    """(B, K) half the distance from each trajectory `[X, X + T]` to the nearest other one (paper, equation 6)."""
    trajectory = torch.cat([table.center, table.center + table.translation, rotation_weight * table.rotation], dim=-1)
    distance = (trajectory[:, :, None] - trajectory[:, None]).norm(dim=-1)
    real = table.label > 0
    other = real[:, :, None] & real[:, None] & ~torch.eye(real.shape[1], dtype=torch.bool, device=real.device)
    least = torch.where(other, distance, torch.inf).amin(dim=-1)
    return torch.where(torch.isfinite(least), 0.5 * least, RADIUS_ALONE)


def _nearest_to_center(distance2: Tensor, index: Tensor, measured: Tensor, objects: int, count: int) -> Tensor:
    """(B, H, W) bool: the `count` pixels with depth of each object that lie nearest to its centre."""
    batch = torch.arange(index.shape[0], device=index.device)[:, None, None]
    group = torch.where(measured & (index >= 0), index + batch * objects, -1).flatten()
    # Two stable sorts give the rank of each pixel within its object, without a loop over objects.
    order = torch.argsort(distance2.flatten(), stable=True)
    order = order[torch.argsort(group[order], stable=True)]
    ordered = group[order]
    first = torch.searchsorted(ordered, ordered, right=False)
    rank = torch.arange(len(ordered), device=index.device) - first
    chosen = torch.zeros_like(group, dtype=torch.bool)
    chosen[order] = (rank < count) & (ordered >= 0)
    return chosen.view(index.shape)
