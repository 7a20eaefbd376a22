"""The dense maps that the network predicts, and the scene flow that follows from them (equation 1 of the paper)."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from objectflow.geometry.torch_se3 import rigid_flow


class SceneFlowNetOutput(NamedTuple):
    """Per-pixel predictions on the current frame's pixels: (B, C, H, W) in the network's dtype.

    Attributes:
        rotation: C = 3, axis-angle in radians, Q of the paper: from the current to the previous frame.
        translation: C = 3, metres, T: displacement of the object's centre.
        center: C = 3, metres, camera frame, X: the object's centre in the current frame.
        mask: C = 2, logits of background and foreground.
        centrality: C = 2, logits of eta: 1 near the object's centroid, else 0.
        radius: C = 1, metres in trajectory space, B: the ball around a pixel's feature contains that of its object and
            no other object's.
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
    """Equation 1: the displacement of each point to its previous position, `R (P - X) + X + T - P`.

    Args:
        rotation: (B, 3, ...) axis-angle in radians.
        translation, center: (B, 3, ...) metres.
        points: (B, 3, ...) metres, in the current frame; NaN where depth is missing.

    Returns:
        (B, 3, ...) metres; NaN where points are. The gradient is finite at rotation 0.
    """
    return rigid_flow(points, rotation, translation, center)
