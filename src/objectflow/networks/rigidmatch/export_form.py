"""A `RigidMatch` up to its solve, for runtimes without singular value decomposition."""

from __future__ import annotations

from typing import ClassVar

from torch import Tensor, nn

from objectflow.networks.rigidmatch.network import RigidMatch


class ExportableRigidMatch(nn.Module):
    """The network up to the solve.

    Its outputs, by `OUTPUTS`: points and matches (B, 3, H, W) in metres of the fine grid, the weights (B, Q, H, W) of
    each object's matches in its solve, anchors, objectness, masks and moves of the last layer, and upsampling, detail
    queries and details for `outputs.pixel_masks`. The motions follow by
    `rigid_solver.solve_motions(weights, points, matches, anchors, prior=PRIOR)`.
    """

    OUTPUTS: ClassVar[tuple[str, ...]] = (
        "points", "match", "weights", "anchors", "objectness", "masks", "moves", "upsampling", "detail_queries",
        "details",
    )  # fmt: skip

    def __init__(self, network: RigidMatch) -> None:
        super().__init__()
        self.network = network

    def forward(
        self, prev_color: Tensor, prev_points: Tensor, curr_color: Tensor, curr_points: Tensor
    ) -> tuple[Tensor, ...]:
        """See `RigidMatch.forward`."""
        found = self.network.forward_features(prev_color, prev_points, curr_color, curr_points)
        return (
            found.points.points,
            found.refined.match,
            found.weights(),
            found.objects.anchors,
            found.objects.objectness[-1],
            found.objects.masks[-1],
            found.moves,
            found.dense.upsampling,
            found.objects.detail_queries,
            found.dense.details,
        )
