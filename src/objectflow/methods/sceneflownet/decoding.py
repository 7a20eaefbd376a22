"""Decoding of one pair's dense maps: grouping of pixels, one rigid motion per group, and scene flow."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from objectflow.errors import MethodError
from objectflow.geometry.resample import nearest_indices
from objectflow.methods.labels import relabel_present, rigid_flow
from objectflow.methods.sceneflownet.averaging import average_motions
from objectflow.methods.sceneflownet.grouping import GroupingSettings, group, trajectory_feature
from objectflow.motion import ObjectMotion, SceneMotion
from objectflow.networks.sceneflownet.outputs import SceneFlowNetOutput, scene_flow
from objectflow.typing import BoolMask, Float32Array, LabelImage


def decode(
    output: SceneFlowNetOutput,
    curr_points: Tensor,
    *,
    rigid: Literal["none", "average"] = "average",
    grouping: GroupingSettings | None = None,
) -> SceneMotion:
    """Decode the maps of one pair at their own resolution.

    Args:
        output: (1, C, H, W) on any device.
        curr_points: (1, 3, H, W) metres, NaN where depth is missing.
        rigid: "none" uses each pixel's own flow (equation 1), "average" the flow of its object's mean motion.
        grouping: settings; the defaults if None.

    Returns:
        Labels, objects with their mean motions, and scene flow: 0 outside objects, NaN where depth is missing.

    Raises:
        MethodError: the batch has more than one pair, the sizes differ, or `rigid` is unknown.
    """
    if rigid not in ("none", "average"):
        raise MethodError(f"rigid must be none or average here, not {rigid!r}")
    if output.mask.shape[0] != 1 or curr_points.shape != (1, 3, *output.mask.shape[-2:]):
        raise MethodError(
            f"one pair's maps and points are needed, not {tuple(output.mask.shape)} and {tuple(curr_points.shape)}"
        )
    measured = torch.isfinite(curr_points[0]).all(dim=0)
    labels = label_pixels(output, grouping)
    labels, objects = relabel_present(labels, average_objects(output, labels, measured.cpu().numpy()))
    points = curr_points[0].permute(1, 2, 0).float().cpu().numpy()
    flow = pixel_flow(output, labels, points) if rigid == "none" else rigid_flow(objects, labels, points)
    return SceneMotion(labels=labels, scene_flow=flow, objects=objects)


def label_pixels(output: SceneFlowNetOutput, grouping: GroupingSettings | None = None) -> LabelImage:
    """Group the foreground of one pair's maps in trajectory space; see `grouping.group`.

    Pixels without depth are included, since the network predicts their motion from the surrounding pixels.

    Returns:
        (H, W) int32, 0 = background.
    """
    grouping = grouping or GroupingSettings()
    rotation, translation, center, mask, centrality, radius = (prediction[0].detach().float() for prediction in output)
    feature = trajectory_feature(center, translation, rotation, grouping.rotation_weight)
    foreground = (mask[1] > mask[0]) & rotation.isfinite().all(dim=0)
    return group(feature, foreground, centrality[1] - centrality[0], radius[0], grouping).cpu().numpy()


def average_objects(output: SceneFlowNetOutput, labels: LabelImage, measured: BoolMask) -> tuple[ObjectMotion, ...]:
    """Average the motion of each label over its pixels with depth; see `averaging.average_motions`.

    Args:
        output: one pair's maps.
        labels: (H, W) int32, from `label_pixels`.
        measured: (H, W) bool, True where depth is valid. X is unreliable elsewhere.

    Returns:
        One object per label with at least one valid depth; its score is the mean foreground probability.
    """
    with torch.no_grad():
        confidence = (output.mask[0, 1] - output.mask[0, 0]).float().sigmoid().cpu().numpy()
    return average_motions(
        np.where(measured, labels, 0).astype(np.int32),
        _array(output.rotation),
        _array(output.translation),
        _array(output.center),
        confidence=confidence,
    )


def pixel_flow(output: SceneFlowNetOutput, labels: LabelImage, points: Float32Array) -> Float32Array:
    """Compute scene flow from each pixel's own Q, T and X (equation 1), without averaging.

    Args:
        output: one pair's maps at any size; each pixel uses the nearest prediction.
        labels: (H, W) int32.
        points: (H, W, 3) metres, NaN where depth is missing.

    Returns:
        (H, W, 3) float32 metres: 0 where labels are 0, NaN where depth is missing.
    """
    rows, columns = nearest_indices(output.mask.shape[-2:], labels.shape)
    y, x = np.nonzero(labels)
    index = torch.from_numpy(rows[y] * output.mask.shape[-1] + columns[x])
    with torch.no_grad():
        Q, T, X = (prediction.float().flatten(2).cpu()[..., index] for prediction in output[:3])
        moved = scene_flow(Q, T, X, torch.from_numpy(points[y, x].T[None].copy()))
    flow = np.where(np.isnan(points), points, np.float32(0))
    flow[y, x] = moved[0].T.numpy()
    return flow


def _array(maps: Tensor) -> NDArray[Any]:
    """(1, 3, H, W) -> (H, W, 3)."""
    return maps[0].detach().permute(1, 2, 0).float().cpu().numpy()
