"""A `RigidMatch` up to its solve, for runtimes without singular value decomposition."""

from __future__ import annotations

from typing import ClassVar

from torch import Tensor, nn

from objectflow.networks.rigidmatch.network import RigidMatch


class ExportableRigidMatch(nn.Module):
    """The network up to the solve.

    Its outputs, by `outputs`: points and matches (B, 3, H, W) in metres of the fine grid, the weights (B, Q, H, W) of
    each object's matches in its solve, anchors, objectness, masks and moves of the last layer, and what
    `outputs.pixel_masks` needs: upsampling, and in networks with details also detail queries and details. The motions
    follow by `rigid_solver.solve_motions(weights, points, matches, anchors, prior=PRIOR)`. The caller scales
    points to the settings' `median_depth`, and lengths back.
    """

    OUTPUTS: ClassVar[tuple[str, ...]] = (
        "points", "match", "weights", "anchors", "objectness", "masks", "moves", "upsampling",
    )  # fmt: skip
    DETAILS: ClassVar[tuple[str, ...]] = ("detail_queries", "details")

    def __init__(self, network: RigidMatch) -> None:
        super().__init__()
        self.network = network
        self.with_details = network.settings.detail_channels > 0
        self.outputs = self.OUTPUTS + (self.DETAILS if self.with_details else ())

    def forward(
        self, prev_color: Tensor, prev_points: Tensor, curr_color: Tensor, curr_points: Tensor
    ) -> tuple[Tensor, ...]:
        """See `RigidMatch.forward`."""
        found = self.network.forward_features(prev_color, prev_points, curr_color, curr_points)
        out = (
            found.points.points,
            found.refined.match,
            found.weights(),
            found.objects.anchors,
            found.objects.objectness[-1],
            found.objects.masks[-1],
            found.moves,
            found.dense.upsampling,
        )
        return (*out, found.objects.detail_queries, found.dense.details) if self.with_details else out
