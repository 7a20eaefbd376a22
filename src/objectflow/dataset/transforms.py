"""The transforms of batches that augmentation combines: turn, flip, swap, crop, rescale and recolour.

The geometry stays exact: the object table still maps every current point to its previous position.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from objectflow.dataset.batches import Batch
from objectflow.dataset.targets import ObjectTable
from objectflow.geometry.torch_resample import sampling_grid
from objectflow.sensors import depth_maps

_LABELS = 256
"""Number of label values: labels are stored in 8 bits."""
_IMAGES = ("prev_color", "curr_color", "prev_depth", "curr_depth", "prev_labels", "curr_labels")


def flip(batch: Batch, which: Tensor) -> Batch:
    """Mirror the pairs selected by (B,) bool left to right, with the scene: x of X and T, y and z of Q change sign."""

    def mirror(values: Tensor) -> Tensor:
        return torch.where(which.view(-1, *[1] * (values.ndim - 1)), values.flip(-1), values)

    def sign(*signs: float) -> Tensor:
        wanted = torch.tensor(signs, device=which.device)
        return torch.where(which[:, None], wanted, torch.ones_like(wanted))[:, None]

    fx, fy, cx, cy = batch.intrinsics.unbind(1)
    cx = torch.where(which, batch.curr_depth.shape[-1] - 1 - cx, cx)
    table = replace(
        batch.table,
        center=batch.table.center * sign(-1, 1, 1),
        translation=batch.table.translation * sign(-1, 1, 1),
        # M R M with the mirror M: the axis is mirrored, and the rotation about it is reversed.
        rotation=batch.table.rotation * sign(1, -1, -1),
    )
    images: dict[str, Any] = {name: mirror(getattr(batch, name)) for name in _IMAGES}
    if batch.camera_motion is not None:
        signs = torch.tensor([-1.0, 1, 1, 1], device=which.device)
        mirrored = signs[:, None] * batch.camera_motion * signs
        images["camera_motion"] = torch.where(which[:, None, None], mirrored, batch.camera_motion)
    return replace(batch, intrinsics=torch.stack([fx, fy, cx, cy], 1), table=table, **images)


def turn(batch: Batch, quarters: int) -> Batch:
    """Turn all pairs counter-clockwise by quarter turns; odd numbers exchange height and width.

    The camera is turned about its optical axis: (x, y) becomes (y, -x), and with it all vectors of the table.
    """
    for _ in range(quarters % 4):
        width = batch.curr_depth.shape[-1]
        images: dict[str, Any] = {name: getattr(batch, name).rot90(1, (-2, -1)) for name in _IMAGES}
        fx, fy, cx, cy = batch.intrinsics.unbind(1)
        quarter = torch.tensor([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]], device=batch.intrinsics.device)
        vectors = {name: getattr(batch.table, name) @ quarter.T for name in ("center", "translation", "rotation")}
        if batch.camera_motion is not None:
            camera = torch.eye(4, device=quarter.device)
            camera[:3, :3] = quarter
            images["camera_motion"] = camera @ batch.camera_motion @ camera.T
        intrinsics = torch.stack([fy, fx, cy, width - 1 - cx], 1)
        batch = replace(batch, intrinsics=intrinsics, table=replace(batch.table, **vectors), **images)
    return batch


def rescale(batch: Batch, factor: Tensor) -> Batch:
    """Multiply all lengths of each pair by its factor (B,), as if the scene and the camera's path were larger."""
    images: dict[str, Any] = {
        name: factor[:, None, None] * getattr(batch, name) for name in ("prev_depth", "curr_depth")
    }
    table = replace(
        batch.table,
        center=factor[:, None, None] * batch.table.center,
        translation=factor[:, None, None] * batch.table.translation,
    )
    if batch.camera_motion is not None:
        scaled = batch.camera_motion.clone()
        scaled[:, :3, 3] *= factor[:, None]
        images["camera_motion"] = scaled
    return replace(batch, table=table, **images)


def swap(batch: Batch, which: Tensor) -> Batch:
    """Swap the frames of the pairs selected by (B,) bool: X becomes X + T, T becomes -T, R becomes its inverse."""

    def choose(yes: Tensor, no: Tensor) -> Tensor:
        return torch.where(which.view(-1, *[1] * (yes.ndim - 1)), yes, no)

    images: dict[str, Any] = {}
    for name in ("color", "depth", "labels"):
        prev, curr = getattr(batch, f"prev_{name}"), getattr(batch, f"curr_{name}")
        images[f"prev_{name}"], images[f"curr_{name}"] = choose(curr, prev), choose(prev, curr)
    old = batch.table
    table = replace(
        old,
        center=choose(old.center + old.translation, old.center),
        translation=choose(-old.translation, old.translation),
        rotation=choose(-old.rotation, old.rotation),
    )
    if batch.camera_motion is not None:
        images["camera_motion"] = choose(torch.linalg.inv(batch.camera_motion), batch.camera_motion)
    return replace(batch, table=table, **images)


def crop(batch: Batch, zoom: Tensor, place: Tensor) -> Batch:
    """Enlarge a crop of every pair to the size of the image.

    Colour is interpolated. Labels are those of the nearest pixel. Depth is that of the nearest pixel, extrapolated to
    the ray of the new pixel along the local surface: exact on planes, without mixing surfaces. Objects with no pixel
    in either frame are removed from the table; those with pixels in only one frame are no longer `in_both`.

    Args:
        batch: exact frames.
        zoom: (B,) at least 1.
        place: (B, 2) in 0..1: position of the crop between the left and right, and the top and bottom borders.
    """
    height, width = batch.curr_depth.shape[-2:]
    zoom = zoom[:, None]
    corner = place * (1 - 1 / zoom) * place.new_tensor([width, height])
    left, top = corner[:, :1], corner[:, 1:]
    # Pixel centres are whole numbers, so the corner of the image lies at -0.5.
    u = (torch.arange(width, device=zoom.device) + 0.5) / zoom + left - 0.5
    v = (torch.arange(height, device=zoom.device) + 0.5) / zoom + top - 0.5
    size = (len(zoom), height, width)
    u, v = u[:, None].expand(size), v[:, :, None].expand(size)
    images: dict[str, Any] = {}
    for name in ("prev_color", "curr_color"):
        color = getattr(batch, name).float()
        grid = sampling_grid(u, v, height, width)
        moved = F.grid_sample(color, grid, mode="bilinear", padding_mode="border", align_corners=False)
        images[name] = moved.round().to(torch.uint8)
    column, row = u.round().clamp(0, width - 1), v.round().clamp(0, height - 1)
    nearest = (row * width + column).long().flatten(1)

    def at(values: Tensor) -> Tensor:
        return values.flatten(1).gather(1, nearest).view(size)

    for name in ("prev_depth", "curr_depth"):
        inverse = depth_maps.inverse_depth(getattr(batch, name))
        slope_x, slope_y, _ = depth_maps.slopes(inverse)
        known = at(inverse)
        moved = known + at(slope_x) * (u - column) + at(slope_y) * (v - row)
        images[name] = depth_maps.depth_of(torch.where(known > 0, moved, 0.0))
    for name in ("prev_labels", "curr_labels"):
        images[name] = at(getattr(batch, name))
    focal, center = batch.intrinsics[:, :2], batch.intrinsics[:, 2:]
    intrinsics = torch.cat([zoom * focal, zoom * (center + 0.5 - corner) - 0.5], 1)
    table = _with_visibility(batch.table, images["prev_labels"], images["curr_labels"])
    return replace(batch, intrinsics=intrinsics, table=table, **images)


def _with_visibility(table: ObjectTable, prev_labels: Tensor, curr_labels: Tensor) -> ObjectTable:
    def has_pixels(labels: Tensor) -> Tensor:
        found = torch.zeros(len(labels), _LABELS, dtype=torch.bool, device=labels.device)
        return found.scatter_(1, labels.flatten(1).long(), True).gather(1, table.label)

    before, now = has_pixels(prev_labels), has_pixels(curr_labels)
    label = torch.where(before | now, table.label, 0)
    return replace(table, label=label, in_both=table.in_both & before & now)


def recolor(batch: Batch, amounts: Tensor) -> Batch:
    """Change brightness, contrast, saturation and hue by amounts (B, 2, 4), for the previous and the current frame."""
    # In YIQ, luma and two colour differences, hue rotates the differences and saturation scales them.
    to_yiq = torch.tensor(
        [[0.299, 0.587, 0.114], [0.596, -0.274, -0.322], [0.211, -0.523, 0.312]], device=amounts.device
    )
    images: dict[str, Any] = {}
    for i, name in enumerate(("prev_color", "curr_color")):
        brightness, contrast, saturation, hue = amounts[:, i].unbind(1)
        scale = (1 + saturation).clamp_min(0)
        turn = torch.zeros(len(amounts), 3, 3, device=amounts.device)
        turn[:, 0, 0] = 1
        turn[:, 1, 1] = turn[:, 2, 2] = scale * hue.cos()
        turn[:, 1, 2], turn[:, 2, 1] = -scale * hue.sin(), scale * hue.sin()
        mix = torch.linalg.inv(to_yiq) @ turn @ to_yiq
        color = torch.einsum("bij,bjhw->bihw", mix, getattr(batch, name).float())
        middle = color.mean(dim=(1, 2, 3), keepdim=True)
        stretch, gain = (1 + contrast).clamp_min(0), (1 + brightness).clamp_min(0)
        color = ((color - middle) * stretch.view(-1, 1, 1, 1) + middle) * gain.view(-1, 1, 1, 1)
        images[name] = color.round().clamp(0, 255).to(torch.uint8)
    return replace(batch, **images)
