"""The dense maps that a network predicts, and the scene flow that they mean (equation 1 of the paper)."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

_SMALL_ANGLE = 1e-2
"""Radians below which the series to the fourth power are exact in float32, and their gradients finite at 0."""


class SceneFlowNetOutput(NamedTuple):
    """Per-pixel predictions on the current frame's pixels: (B, C, H, W) in the network's dtype.

    Attributes:
        rotation: C = 3, axis-angle in radians, Q of the paper: from the current to the previous frame.
        translation: C = 3, metres, T: displacement of the object's centre.
        center: C = 3, metres, camera frame, X: the object's centre in the current frame.
        mask: C = 2, logits of background and foreground.
        centrality: C = 2, logits of eta: 0 no, 1 yes, near the object's centroid.
        radius: C = 1, metres in trajectory space, B: around a pixel's feature lies its object's, and no other's.
    """

    rotation: Tensor
    translation: Tensor
    center: Tensor
    mask: Tensor
    centrality: Tensor
    radius: Tensor

    @property
    def trajectory(self) -> Tensor:
        """(B, 6, H, W) metres: xi = [X, X + T]."""
        return torch.cat([self.center, self.center + self.translation], dim=1)


def scene_flow(rotation: Tensor, translation: Tensor, center: Tensor, points: Tensor) -> Tensor:
    """Equation 1: where each point was, less where it is: `R (P - X) + X + T - P`.

    Args:
        rotation: (B, 3, ...) axis-angle in radians.
        translation, center: (B, 3, ...) metres.
        points: (B, 3, ...) metres, in the current frame; NaN where depth is missing.

    Returns:
        (B, 3, ...) metres; NaN where points are. The gradient is finite at rotation 0.
    """
    arm = points - center
    squared = (rotation * rotation).sum(dim=1, keepdim=True)
    small = squared < _SMALL_ANGLE**2
    # The unused branch must be finite too, or its gradient turns 0 times infinity into NaN.
    angle = torch.where(small, torch.ones_like(squared), squared).sqrt()
    first = torch.where(small, 1 - squared / 6 + squared * squared / 120, angle.sin() / angle)
    # 1 - cos t loses digits; 2 sin^2(t / 2) does not.
    large = 2 * ((angle / 2).sin() / angle) ** 2
    second = torch.where(small, 0.5 - squared / 24 + squared * squared / 720, large)
    turned = torch.linalg.cross(rotation, arm, dim=1)
    # (R - I)(P - X) by Rodrigues, so that small motions keep their digits in float32.
    flow: Tensor = first * turned + second * torch.linalg.cross(rotation, turned, dim=1) + translation
    return flow
