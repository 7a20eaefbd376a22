"""Decoding of `RigidMatch` outputs into labels and objects, used by the estimator and by validation."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from objectflow import geometry
from objectflow.errors import MethodError
from objectflow.geometry.resample import nearest_indices
from objectflow.methods.labels import relabel_present, rigid_flow
from objectflow.methods.rigidmatch.duplicates import merge_duplicates
from objectflow.motion import ObjectMotion, SceneMotion
from objectflow.networks.rigidmatch.inputs import clean_points, grid
from objectflow.networks.rigidmatch.outputs import RigidMatchOutput, between_cells, upsampled_masks
from objectflow.typing import Float32Array, LabelImage

OBJECT_MASK_THRESHOLD = 0.05
"""Minimum object probability, 0..1. It is low because overlapping and static objects are removed later; chosen on
validation pairs and on real pairs."""
QUERY_THRESHOLD = 0.05
"""Highest minimum probability, 0..1, of a query: several queries may share one object, whose probability is higher."""
DUPLICATE_IOU = 0.7
"""Minimum intersection over union, 0..1, of the masks of two queries on one object."""
OVERLAP_THRESHOLD = 0.5
"""Minimum share of its mask, 0..1, that an object keeps where masks overlap; an object with less is removed."""
MASK_THRESHOLD = 0.5
"""Probability, 0..1, above which a pixel belongs to a mask, and above which an object is decoded as moving."""
MIN_PIXELS = 20
"""Minimum size of an object in pixels of the network's input."""


def output_to_motion(
    output: RigidMatchOutput,
    curr_points: Tensor,
    *,
    threshold: float = OBJECT_MASK_THRESHOLD,
    min_pixels: int = MIN_PIXELS,
) -> SceneMotion:
    """Decode one pair into objects and the scene flow of their motions, at the network's input resolution.

    Args:
        output: the output for one pair, as returned by `select`.
        curr_points: (1, 3, H, W) metres, NaN where depth is missing.
        threshold: minimum object probability.
        min_pixels: minimum size of an object in pixels.
    """
    height, width = curr_points.shape[-2:]
    labels, objects = decode(output, (height, width), threshold=threshold, min_pixels=min_pixels)
    points = curr_points[0].permute(1, 2, 0).float().cpu().numpy()
    return SceneMotion(labels=labels, scene_flow=rigid_flow(objects, labels, points), objects=objects)


def select(output: RigidMatchOutput, index: int) -> RigidMatchOutput:
    """Select one pair from a batch's output."""
    batch_second = ("objectness", "masks")
    parts = {
        name: value[:, index : index + 1] if name in batch_second else value[index : index + 1]
        for name, value in output._asdict().items()
    }
    return RigidMatchOutput(**parts)


@torch.no_grad()
def decode(
    output: RigidMatchOutput,
    size: tuple[int, int],
    *,
    threshold: float = OBJECT_MASK_THRESHOLD,
    min_pixels: int = MIN_PIXELS,
    overlap_threshold: float = OVERLAP_THRESHOLD,
    duplicate_iou: float = DUPLICATE_IOU,
) -> tuple[LabelImage, tuple[ObjectMotion, ...]]:
    """Merge queries on one object, then assign each pixel to its most probable object.

    The assignment is that of MaskFormer (Cheng et al. 2021).

    Args:
        output: the output for one pair.
        size: (H, W) of the network's input.
        threshold: minimum object probability.
        min_pixels: minimum size of an object in pixels.
        overlap_threshold: minimum share of its mask that an object keeps where masks overlap.
        duplicate_iou: minimum intersection over union of two masks of one object; 1 merges none.

    Returns:
        (H, W) int32 labels, 0 = background, and one object per label.

    Raises:
        MethodError: the output has more than one pair.
    """
    if output.moves.shape[0] != 1:
        raise MethodError(
            f"decoding needs the output for one pair, not for {output.moves.shape[0]}: choose one with select()"
        )
    probability = output.objectness[-1, 0].sigmoid()
    kept = torch.nonzero(probability > min(threshold, QUERY_THRESHOLD))[:, 0]
    if not len(kept):
        return np.zeros(size, np.int32), ()
    queries = output.detail_queries[:, kept]
    logits = upsampled_masks(output.masks[-1][:, kept], output.upsampling, queries, output.details)
    merged = merge_duplicates(logits[0], probability[kept], duplicate_iou)
    sure = torch.nonzero(merged.probability > threshold)[:, 0]
    if not len(sure):
        return np.zeros(size, np.int32), ()
    masks = merged.logits[sure]
    if queries.shape[-1]:
        masks = between_cells(masks[None])[0]
    masks = masks[:, : size[0], : size[1]].flatten(1)
    # Pixels that lie in no mask are background, whichever mask is the most probable one there.
    claimed = torch.nonzero(masks.amax(0) > math.log(MASK_THRESHOLD / (1 - MASK_THRESHOLD)))[:, 0]
    claim = masks[:, claimed].sigmoid()
    won, counts, left = resolve_overlaps(claim, merged.probability[sure], min_pixels, overlap_threshold)
    if not len(left):
        return np.zeros(size, np.int32), ()
    sure = sure[left]
    kept = kept[merged.best[sure]]
    labels = np.zeros(size, np.int32)
    labels.ravel()[claimed.cpu().numpy()] = won.cpu().numpy()
    R, t, center, moves, score = (
        values.double().cpu().numpy()
        for values in (
            output.rotation[0, kept],
            output.translation[0, kept],
            output.anchors[0, kept, :3],
            output.moves[0, kept].sigmoid(),
            probability[kept],
        )
    )
    transforms = geometry.make_transform(R, t)
    objects = tuple(
        ObjectMotion(
            id=k + 1,
            pixels=counts[k],
            score=float(score[k]),
            moving=bool(moves[k] > MASK_THRESHOLD),
            center=center[k],
            prev_T_curr=transforms[k],
        )
        for k in range(len(kept))
    )
    return relabel_present(labels, objects)


def resolve_overlaps(
    claim: Tensor, sure: Tensor, least: int, overlap_threshold: float
) -> tuple[Tensor, list[int], Tensor]:
    """Assign pixels to masks, and remove masks until each remaining mask keeps enough of its pixels.

    Args:
        claim: (K, P) mask probability per pixel.
        sure: (K,) object probability.
        least: minimum number of pixels assigned to a mask.
        overlap_threshold: minimum share of its pixels that a mask keeps.

    Returns:
        (P,) number from 1 of the pixel's mask among the remaining masks, 0 where the mask probability is at most
        `MASK_THRESHOLD`; the number of pixels of each remaining mask; the indices of the remaining masks.
    """
    inside = claim > MASK_THRESHOLD
    areas = inside.sum(1).cpu().numpy()
    scores = claim * sure[:, None]
    winner = _best_rows(scores)
    removed = np.zeros(len(claim), bool)
    while True:
        won = inside.gather(0, winner[None])[0]
        counts = torch.bincount(winner[won], minlength=len(claim)).cpu().numpy()
        share = counts / np.maximum(areas, 1)
        weak = ~removed & ((counts < least) | (counts < overlap_threshold * areas))
        if not weak.any():
            break
        # The mask with the smallest share is removed first, since its pixels may raise the share of another mask.
        worst = int(np.where(weak, share, 2.0).argmin())
        removed[worst] = True
        if removed.all():
            break
        scores[worst] = -1
        free = torch.nonzero(winner == worst)[:, 0]
        winner[free] = _best_rows(scores[:, free])
    left = torch.from_numpy(np.flatnonzero(~removed)).to(claim.device)
    number = torch.zeros(len(claim), dtype=torch.long, device=claim.device)
    number[left] = torch.arange(1, len(left) + 1, device=claim.device)
    return torch.where(won, number[winner], 0), counts[~removed].tolist(), left


def _best_rows(scores: Tensor) -> Tensor:
    """(P,) int64 row of the first maximum of each column of (K, P); ten times as fast as `argmax` for few rows."""
    best, winner = scores[0], torch.zeros(scores.shape[1], dtype=torch.long, device=scores.device)
    for row, values in enumerate(scores[1:], start=1):
        winner.masked_fill_(values > best, row)
        best = torch.maximum(best, values)
    return winner


@torch.no_grad()
def matched_flow(
    output: RigidMatchOutput, curr_points: Tensor, stride: int, labels: LabelImage, points: Float32Array
) -> Float32Array:
    """Compute the scene flow of each pixel's nearest match, without a rigid fit.

    Args:
        output: the output for one pair.
        curr_points: (1, 3, h, w) metres, the network's input.
        stride: pixels per fine cell.
        labels: (H, W) int32, at any size with the aspect ratio of the network's input.
        points: (H, W, 3) metres, NaN where depth is missing.

    Returns:
        (H, W, 3) float32 metres: 0 where labels are 0, NaN where depth is missing.
    """
    height, width = curr_points.shape[-2:]
    own = grid(*clean_points(curr_points), stride).points
    shift = (output.match[..., : own.shape[-2], : own.shape[-1]] - own)[0].permute(1, 2, 0).float().cpu().numpy()
    rows, columns = nearest_indices((height, width), labels.shape)
    rows, columns = (
        np.minimum((index + stride // 2) // stride, length - 1)
        for index, length in zip((rows, columns), shift.shape, strict=False)
    )
    flow = np.where(labels[..., None] > 0, shift[rows[:, None], columns], np.float32(0))
    return np.where(np.isnan(points), points, flow).astype(np.float32)
