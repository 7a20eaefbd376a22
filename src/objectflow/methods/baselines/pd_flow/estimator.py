"""The `pd-flow` estimator: coarse-to-fine levels, and the flow on the pixels of the input."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from objectflow.alignment.appearance import to_gray
from objectflow.alignment.frame_pair import FramePair
from objectflow.frame import MAX_MEDIAN_DEPTH, MIN_MEDIAN_DEPTH, RgbdFrame
from objectflow.geometry import torch_pinhole
from objectflow.methods.baselines.guided_upsampling import upsample_guided
from objectflow.methods.baselines.pd_flow.linearise import linearise
from objectflow.methods.baselines.pd_flow.median import weighted_median
from objectflow.methods.baselines.pd_flow.primal_dual import State, solve
from objectflow.methods.baselines.pd_flow.pyramid import Images, build_pyramid, upsample_flow
from objectflow.methods.moving_camera import StaticCameraEstimator
from objectflow.motion import SceneMotion
from objectflow.runtime.devices import find_device

WIDTH, HEIGHT = 320, 240
ITERATIONS = (40, 55, 70, 85, 100)
"""Iterations of the primal-dual solver per level, coarsest first."""
_MAX_INCREMENT = 1.0
"""Largest increment of u and v per level, pixels."""


@dataclass(frozen=True)
class PdFlow(StaticCameraEstimator):
    """Primal-dual scene flow; flow only, no objects."""

    device: str = "auto"
    """auto, cpu, cuda or cuda:N."""

    def __post_init__(self) -> None:
        super().__post_init__()
        find_device(self.device)

    def estimate_static(self, pairs: Sequence[FramePair]) -> list[SceneMotion]:
        """See `StaticCameraEstimator`. Frames of any size are processed at 320x240.

        Raises:
            FrameError: a frame has no depth at 320x240.
        """
        return [self._estimate(pair.prev.frame, pair.curr.frame) for pair in pairs]

    def _estimate(self, prev: RgbdFrame, curr: RgbdFrame) -> SceneMotion:
        device = find_device(self.device)
        first, second = (_images(frame.resized(WIDTH, HEIGHT), device) for frame in (curr, prev))
        uvw = estimate(first, second)[0].permute(1, 2, 0).cpu().numpy()
        uvw = upsample_guided(uvw, first.depth[0, 0].cpu().numpy(), curr.depth)
        uvw[..., 0] *= curr.camera.width / WIDTH
        uvw[..., 1] *= curr.camera.height / HEIGHT
        depth, K = torch.from_numpy(curr.depth)[None, None], torch_pinhole.intrinsics(curr.camera)[None]
        flow = lift(torch.from_numpy(uvw).permute(2, 0, 1)[None], depth, K)[0].permute(1, 2, 0).numpy()
        return SceneMotion(
            labels=np.zeros(curr.depth.shape, np.int32),
            scene_flow=np.where(curr.valid[..., None], flow, np.float32(np.nan)),
            method="pd-flow",
        )


@torch.no_grad()
def estimate(first: Images, second: Images) -> Tensor:
    """Estimate the flow of a batch of pairs on the first frames' pixels.

    Args:
        first, second: images of the same size on the same device, height and width multiples of 16.

    Returns:
        (B, 3, H, W): u and v in pixels, w in metres of depth; w is 0 where the first depth is missing.
    """
    levels = [build_pyramid(images, len(ITERATIONS)) for images in (first, second)]
    batch, _, height, width = levels[0][-1].depth.shape
    total = first.depth.new_zeros(batch, 3, height, width)
    state = State(total, total[:, :1], total.repeat(1, 2, 1, 1))
    for number, (a, b) in enumerate(zip(reversed(levels[0]), reversed(levels[1]), strict=True)):
        if number:
            # u and v double with the image size; the duals are upsampled like the flow.
            scale = total.new_tensor([2, 2, 1])[None, :, None, None]
            total = scale * upsample_flow(total)
            state = State(total, upsample_flow(state.depth_dual), upsample_flow(state.smooth_dual))
        level = linearise(a, b, total[:, :2])
        initial = torch.cat([torch.zeros_like(total[:, :2]), total[:, 2:]], 1)
        state = solve(level, state._replace(flow=initial), ITERATIONS[number])
        increment = state.flow[:, :2].clamp(-_MAX_INCREMENT, _MAX_INCREMENT)
        depth_change = torch.where(a.depth > 0, state.flow[:, 2:], 0.0)
        total = torch.cat([total[:, :2] + increment, depth_change], 1)
        total = weighted_median(total, a.depth, level.depth[:, 2:])
    return total


def lift(uvw: Tensor, depth: Tensor, intrinsics: Tensor) -> Tensor:
    """Image displacement and depth change (B, 3, H, W) -> scene flow (B, 3, H, W) in metres.

    Args:
        uvw: u and v in pixels, w in metres.
        depth: (B, 1, H, W) metres.
        intrinsics: (B, 4) fx, fy, cx, cy in pixels.
    """
    points = torch_pinhole.back_project(depth, intrinsics)
    w = uvw[:, 2:]
    lateral = (depth + w) * uvw[:, :2] / intrinsics[:, :2, None, None]
    return torch.cat([lateral + w * points[:, :2] / depth.clamp(min=1e-6), w], 1)


def _images(frame: RgbdFrame, device: torch.device) -> Images:
    plausible = (frame.depth >= MIN_MEDIAN_DEPTH) & (frame.depth <= MAX_MEDIAN_DEPTH)
    depth = np.where(plausible, frame.depth, np.float32(0))
    gray = to_gray(frame.color).astype(np.float32)
    return Images(
        gray=torch.from_numpy(gray)[None, None].to(device),
        depth=torch.from_numpy(depth)[None, None].to(device),
        intrinsics=torch_pinhole.intrinsics(frame.camera)[None].to(device),
    )
