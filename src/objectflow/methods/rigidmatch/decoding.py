"""What a `RigidMatch` says about one pair -> labels and objects; shared by the estimator and by validation."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from objectflow import geometry
from objectflow.errors import MethodError
from objectflow.geometry.resample import nearest_indices
from objectflow.methods.labels import relabel_present, rigid_flow
from objectflow.motion import ObjectMotion, SceneMotion
from objectflow.networks.rigidmatch.inputs import clean_points, grid
from objectflow.networks.rigidmatch.outputs import RigidMatchOutput, pixel_masks
from objectflow.typing import Float32Array, LabelImage

OBJECT_MASK_THRESHOLD = 0.1
"""Least probability of being an object. So low, because two queries on one object share its probability, and because
what overlaps and what does not move is sorted out afterwards; chosen on validation pairs and on real ones."""
OVERLAP_THRESHOLD = 0.5
"""Least share of its mask that an object keeps where others claim the same pixels; with less it says what they say."""
MIN_PIXELS = 20
"""Of the network's input; fewer are no object."""


def output_to_motion(
    output: RigidMatchOutput,
    curr_points: Tensor,
    *,
    threshold: float = OBJECT_MASK_THRESHOLD,
    min_pixels: int = MIN_PIXELS,
) -> SceneMotion:
    """Objects of one pair, on the pixels of the network's input, and the flow that their motions make.

    Args:
        output: of one pair, as `select` gives it.
        curr_points: (1, 3, H, W) metres, NaN where depth is missing.
        threshold: least probability of being an object.
        min_pixels: fewer are no object.
    """
    height, width = curr_points.shape[-2:]
    labels, objects = decode(output, (height, width), threshold=threshold, min_pixels=min_pixels)
    points = curr_points[0].permute(1, 2, 0).float().cpu().numpy()
    return SceneMotion(labels=labels, scene_flow=rigid_flow(objects, labels, points), objects=objects)


def select(output: RigidMatchOutput, index: int) -> RigidMatchOutput:
    """One pair of a batch's output."""
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
) -> tuple[LabelImage, tuple[ObjectMotion, ...]]:
    """Each pixel goes to the object that claims it most (as MaskFormer, Cheng et al. 2021).

    Args:
        output: of one pair.
        size: (H, W) of the network's input.
        threshold: least probability of being an object.
        min_pixels: fewer are no object.

    Returns:
        (H, W) int32 labels, 0 = background, and an object for each.

    Raises:
        MethodError: more than one pair.
    """
    if output.moves.shape[0] != 1:
        raise MethodError(f"one pair's output is needed, not {output.moves.shape[0]}: take one by select")
    sure = output.objectness[-1, 0].sigmoid()
    kept = torch.nonzero(sure > threshold)[:, 0]
    if not len(kept):
        return np.zeros(size, np.int32), ()
    logits = pixel_masks(output.masks[-1][:, kept], output.upsampling, output.detail_queries[:, kept], output.details)
    claim = logits[0, :, : size[0], : size[1]].sigmoid()
    won, counts, left = resolve_overlaps(claim.flatten(1), sure[kept], min_pixels)
    if not len(left):
        return np.zeros(size, np.int32), ()
    kept = kept[left]
    labels = won.reshape(size).to(torch.int32).cpu().numpy()
    R, t, center, moves, score = (
        one.double().cpu().numpy()
        for one in (
            output.rotation[0, kept],
            output.translation[0, kept],
            output.anchors[0, kept, :3],
            output.moves[0, kept].sigmoid(),
            sure[kept],
        )
    )
    transforms = geometry.make_transform(R, t)
    objects = tuple(
        ObjectMotion(
            id=k + 1,
            pixels=counts[k],
            score=float(score[k]),
            moving=bool(moves[k] > 0.5),
            center=center[k],
            prev_T_curr=transforms[k],
        )
        for k in range(len(kept))
    )
    return relabel_present(labels, objects)


def resolve_overlaps(claim: Tensor, sure: Tensor, least: int) -> tuple[Tensor, list[int], Tensor]:
    """Give pixels to masks until every mask that is left keeps enough of its own.

    Args:
        claim: (K, P) each mask's probability at each pixel.
        sure: (K,) probability of being an object.
        least: pixels that a mask has to win.

    Returns:
        (P,) the number from 1 of the winner among the masks left, 0 where it claims less than half; how many pixels
        each has; and which masks are left.
    """
    mine = claim > 0.5
    areas = mine.sum(1).cpu().numpy()
    bids = claim * sure[:, None]
    winner = bids.argmax(dim=0)
    out = np.zeros(len(claim), bool)
    while True:
        won = mine.gather(0, winner[None])[0]
        counts = torch.bincount(winner[won], minlength=len(claim)).cpu().numpy()
        share = counts / np.maximum(areas, 1)
        weak = ~out & ((counts < least) | (counts < OVERLAP_THRESHOLD * areas))
        if not weak.any():
            break
        # The weakest goes first: its pixels may make another whole.
        worst = int(np.where(weak, share, 2.0).argmin())
        out[worst] = True
        if out.all():
            break
        bids[worst] = -1
        free = torch.nonzero(winner == worst)[:, 0]
        winner[free] = bids[:, free].argmax(dim=0)
    left = torch.from_numpy(np.flatnonzero(~out)).to(claim.device)
    number = torch.zeros(len(claim), dtype=torch.long, device=claim.device)
    number[left] = torch.arange(1, len(left) + 1, device=claim.device)
    return torch.where(won, number[winner], 0), counts[~out].tolist(), left


@torch.no_grad()
def matched_flow(
    output: RigidMatchOutput, curr_points: Tensor, stride: int, labels: LabelImage, points: Float32Array
) -> Float32Array:
    """The flow of each pixel's nearest match, before any solve.

    Args:
        output: of one pair.
        curr_points: (1, 3, h, w) metres, what the network was shown.
        stride: pixels a fine cell.
        labels: (H, W) int32, at any size with the proportions of the network's input.
        points: (H, W, 3) metres, NaN where depth is missing.

    Returns:
        (H, W, 3) float32 metres: 0 where labels are 0, NaN where depth is missing.
    """
    height, width = curr_points.shape[-2:]
    own = grid(*clean_points(curr_points), stride).points
    shift = (output.match[..., : own.shape[-2], : own.shape[-1]] - own)[0].permute(1, 2, 0).float().cpu().numpy()
    rows, columns = nearest_indices((height, width), labels.shape)
    rows, columns = (
        np.minimum((one + stride // 2) // stride, most - 1)
        for one, most in zip((rows, columns), shift.shape, strict=False)
    )
    flow = np.where(labels[..., None] > 0, shift[rows[:, None], columns], np.float32(0))
    return np.where(np.isnan(points), points, flow).astype(np.float32)
