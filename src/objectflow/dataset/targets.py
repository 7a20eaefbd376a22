"""Dense training targets from the object table and the label image, on the device, a batch at a time.

Nothing dense is stored: rotation, translation, centre, flow, radius and centre probability of every pixel follow from
a few numbers an object (paper, section III; NETWORK.md gives the constants).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from objectflow.dataset.schema import PairObject
from objectflow.errors import DatasetError

NEAREST = 300
"""D of the paper: so many pixels of an object, the nearest to its centre, are the seeds to learn."""
RADIUS_ALONE = 0.5
"""Metres: B where an object has no other to keep apart from."""


@dataclass(frozen=True, eq=False)
class ObjectTable:
    """The objects of a batch of pairs, padded to one number K.

    Attributes:
        label: (B, K) int64; 0 = no object here.
        center, translation, rotation: (B, K, 3) float32: X and T in metres, R as axis-angle in radians.
        in_both: (B, K) bool: seen in both frames.
    """

    label: Tensor
    center: Tensor
    translation: Tensor
    rotation: Tensor
    in_both: Tensor

    @classmethod
    def from_rows(cls, rows: Sequence[Sequence[PairObject]]) -> ObjectTable:
        """Pad the object lists of a batch's rows."""
        count = max([1, *(len(objects) for objects in rows)])
        label = torch.zeros(len(rows), count, dtype=torch.int64)
        values = torch.zeros(len(rows), count, 3, 3)
        in_both = torch.zeros(len(rows), count, dtype=torch.bool)
        for b, objects in enumerate(rows):
            for k, entry in enumerate(objects):
                label[b, k] = entry.label
                in_both[b, k] = entry.in_both
                for position, vector in enumerate((entry.center, entry.translation, entry.rotation_vector)):
                    values[b, k, position] = torch.as_tensor(vector, dtype=torch.float32)
        return cls(label, values[:, :, 0], values[:, :, 1], values[:, :, 2], in_both)

    def to(self, device: torch.device | str) -> ObjectTable:
        """The table on another device."""
        moved = (getattr(self, name).to(device, non_blocking=True) for name in self.__dataclass_fields__)
        return ObjectTable(*moved)


@dataclass(frozen=True, eq=False)
class Targets:
    """What a network should say at each pixel of the current frame; 0 off the objects.

    Attributes:
        mask: (B, H, W) bool: a pixel of an object.
        seen: (B, H, W) bool: of an object that both frames see; the paper's masked metrics look only here.
        index: (B, H, W) int64: its row in the object table, -1 for the background.
        rotation, translation, center: (B, 3, H, W) Q in radians, T and X in metres.
        flow: (B, 3, H, W) metres, equation 1; 0 where depth is missing. With a moving camera not 0 off the objects:
            `with_camera`.
        radius: (B, 1, H, W) metres, B.
        eta: (B, H, W) bool: one of the pixels nearest to the object's centre.
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
    table: ObjectTable, labels: Tensor, points: Tensor, *, nearest: int = NEAREST, rotation_weight: float = 0.0
) -> Targets:
    """Targets of a batch.

    Args:
        table: the objects, on the device of the images.
        labels: (B, H, W) integer label image of the current frame.
        points: (B, 3, H, W) metres, the current frame's points; NaN or z <= 0 where depth is missing.
        nearest: how many pixels an object teaches as its centre.
        rotation_weight: metres a radian; with it, B counts rotations into the trajectories, as the grouping may.

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
    nine = _spread(_rotation_matrices(table.rotation).flatten(2), index)
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
    """Targets whose flow off the objects is the camera's motion.

    Args:
        targets: of a batch.
        points: (B, 3, H, W) metres, as `make_targets` took them.
        camera_motion: (B, 4, 4) `prev_T_curr` of everything that stands still; None for a camera that does.
    """
    if camera_motion is None:
        return targets
    safe = torch.where((points[:, 2:] > 0) & torch.isfinite(points[:, 2:]), points, torch.zeros_like(points))
    turned = torch.einsum("bij,bjhw->bihw", camera_motion[:, :3, :3], safe) + camera_motion[:, :3, 3, None, None]
    shown = ~targets.mask & (safe[:, 2] > 0)
    return replace(targets, flow=torch.where(shown[:, None], turned - safe, targets.flow))


def _rows_of(table: ObjectTable, labels: Tensor) -> Tensor:
    """(B, H, W) row of each pixel's object, -1 for the background."""
    top = int(torch.maximum(labels.max(), table.label.max())) + 1
    lookup = torch.full((labels.shape[0], top), -2, dtype=torch.int64, device=labels.device)
    rows = torch.arange(table.label.shape[1], device=labels.device).expand_as(table.label)
    lookup.scatter_(1, table.label, rows)
    lookup[:, 0] = -1  # padding has label 0 as well
    index = lookup.gather(1, labels.flatten(1).long()).view(labels.shape)
    if bool((index == -2).any()):
        raise DatasetError("a label image holds a label that its object table lacks: check the data set")
    return index


def _spread(values: Tensor, index: Tensor) -> Tensor:
    """(B, K, C) an object -> (B, C, H, W) a pixel; 0 on the background."""
    batch, _, channels = values.shape
    flat = index.flatten(1).clamp(min=0)[..., None].expand(-1, -1, channels)
    dense = values.gather(1, flat) * (index.flatten(1) >= 0)[..., None]
    return dense.transpose(1, 2).reshape(batch, channels, *index.shape[1:])


def _rotation_matrices(vectors: Tensor) -> Tensor:
    """Axis-angle (..., 3) -> (..., 3, 3), Rodrigues; sinc keeps it exact at 0."""
    angle = vectors.norm(dim=-1)[..., None, None]
    zero = torch.zeros_like(vectors[..., 0])
    x, y, z = vectors.unbind(-1)
    skew = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).reshape(*vectors.shape, 3)
    a = torch.sinc(angle / torch.pi)
    b = 0.5 * torch.sinc(angle / (2 * torch.pi)) ** 2
    rotation: Tensor = torch.eye(3, device=vectors.device, dtype=vectors.dtype) + a * skew + b * (skew @ skew)
    return rotation


def _radii(table: ObjectTable, rotation_weight: float) -> Tensor:
    """(B, K) half the distance of each trajectory `[X, X + T]` to the nearest other (paper, equation 6)."""
    trajectory = torch.cat([table.center, table.center + table.translation, rotation_weight * table.rotation], dim=-1)
    distance = (trajectory[:, :, None] - trajectory[:, None]).norm(dim=-1)
    real = table.label > 0
    other = real[:, :, None] & real[:, None] & ~torch.eye(real.shape[1], dtype=torch.bool, device=real.device)
    least = torch.where(other, distance, torch.inf).amin(dim=-1)
    return torch.where(torch.isfinite(least), 0.5 * least, RADIUS_ALONE)


def _nearest_to_center(distance2: Tensor, index: Tensor, measured: Tensor, objects: int, count: int) -> Tensor:
    """(B, H, W) bool: the `count` pixels of each object that lie nearest to its centre, of those with depth."""
    batch = torch.arange(index.shape[0], device=index.device)[:, None, None]
    group = torch.where(measured & (index >= 0), index + batch * objects, -1).flatten()
    # Two stable sorts give each pixel its rank within its object, without a loop over objects.
    order = torch.argsort(distance2.flatten(), stable=True)
    order = order[torch.argsort(group[order], stable=True)]
    ordered = group[order]
    first = torch.searchsorted(ordered, ordered, right=False)
    rank = torch.arange(len(ordered), device=index.device) - first
    chosen = torch.zeros_like(group, dtype=torch.bool)
    chosen[order] = (rank < count) & (ordered >= 0)
    return chosen.view(index.shape)
