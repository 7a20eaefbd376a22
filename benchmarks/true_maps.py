"""The maps that a perfect network would predict for an analytic scene."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn

import analytic
from objectflow import geometry
from objectflow.dataset.targets import ObjectTable, make_targets
from objectflow.networks import SceneFlowNetOutput
from objectflow.typing import LabelImage


class Truth(nn.Module):
    """A network that knows the answer: maps of a scene's objects on given labels."""

    def __init__(self, pair: analytic.AnalyticPair, labels: LabelImage) -> None:
        super().__init__()
        self.nothing = nn.Parameter(torch.zeros(1))
        self.labels = torch.from_numpy(labels)[None]
        ids = sorted(pair.prev_T_curr)
        X = np.stack([pair.centers[k] for k in ids])
        motions = np.stack([pair.prev_T_curr[k] for k in ids])
        T = np.einsum("kij,kj->ki", motions[:, :3, :3], X) + motions[:, :3, 3] - X
        Q = geometry.so3_log(motions[:, :3, :3])
        X_, T_, Q_ = (torch.from_numpy(x).float()[None] for x in (X, T, Q))
        self.table = ObjectTable(torch.tensor([ids]), X_, T_, Q_, torch.ones(1, len(ids), dtype=torch.bool))

    def forward(
        self, prev_color: Tensor, prev_points: Tensor, curr_color: Tensor, curr_points: Tensor
    ) -> SceneFlowNetOutput:
        """The true maps, whatever the images show."""
        assert prev_color.shape == prev_points.shape == curr_color.shape == curr_points.shape
        assert 0 <= float(curr_color.min()) <= float(curr_color.max()) <= 1
        assert curr_points.shape[2:] == self.labels.shape[1:]
        truth = make_targets(self.table, self.labels, curr_points)
        mask, eta = truth.mask.float()[:, None], truth.eta.float()[:, None]
        return SceneFlowNetOutput(
            rotation=truth.rotation,
            translation=truth.translation,
            center=truth.center,
            mask=torch.cat([3 - 6 * mask, 6 * mask - 3], dim=1),
            centrality=torch.cat([1 - eta, eta], dim=1),
            radius=truth.radius,
        )
