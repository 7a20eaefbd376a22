"""The estimator: levels from coarse to fine, and the flow on the pixels of the input."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from objectflow.alignment import matching
from objectflow.frame import MAX_MEDIAN_DEPTH, MIN_MEDIAN_DEPTH, RgbdFrame, check_pair
from objectflow.geometry import torch_pinhole
from objectflow.methods.base import check_camera_option
from objectflow.methods.baselines.enlarge import upsample_guided as to_input
from objectflow.methods.baselines.pd_flow.linearise import linearise
from objectflow.methods.baselines.pd_flow.median import weighted_median
from objectflow.methods.baselines.pd_flow.primal_dual import State, solve
from objectflow.methods.baselines.pd_flow.pyramid import Images, build_pyramid, upsample_flow
from objectflow.motion import SceneMotion
from objectflow.runtime.devices import find_device

WIDTH, HEIGHT = 320, 240
ITERATIONS = (40, 55, 70, 85, 100)
"""Of the primal-dual solver, coarsest level first."""
_FURTHEST_STEP = 1.0
"""Pixels: the most that one level may add to u and v."""


@dataclass(frozen=True)
class PdFlow:
    """Primal-dual scene flow; flow only, no objects.

    Attributes:
        camera: accepted like every method's; the flow of a moving camera's background is simply part of the flow.
        device: "auto", "cpu", "cuda" or "cuda:N".
    """

    camera: str = "auto"
    device: str = "auto"

    def __post_init__(self) -> None:
        check_camera_option(self.camera)
        find_device(self.device)

    def __call__(self, prev: RgbdFrame, curr: RgbdFrame) -> SceneMotion:
        """See `Estimator`. Frames of any size are worked on at 320x240.

        Raises:
            FrameError: the frames differ, or have no depth left at 320x240.
        """
        start = time.perf_counter()
        check_pair(prev, curr)
        device = find_device(self.device)
        first, second = (_images(frame.resized(WIDTH, HEIGHT), device) for frame in (curr, prev))
        uvw = estimate(first, second)[0].permute(1, 2, 0).cpu().numpy()
        uvw = to_input(uvw, first.depth[0, 0].cpu().numpy(), curr.depth)
        uvw[..., 0] *= curr.camera.width / WIDTH
        uvw[..., 1] *= curr.camera.height / HEIGHT
        depth, K = torch.from_numpy(curr.depth)[None, None], torch_pinhole.intrinsics(curr.camera)[None]
        flow = lift(torch.from_numpy(uvw).permute(2, 0, 1)[None], depth, K)[0].permute(1, 2, 0).numpy()
        return SceneMotion(
            labels=np.zeros(curr.depth.shape, np.int32),
            scene_flow=np.where(curr.valid[..., None], flow, np.float32(np.nan)),
            method="pd-flow",
            seconds=time.perf_counter() - start,
        )


@torch.no_grad()
def estimate(first: Images, second: Images) -> Tensor:
    """The flow of a batch of pairs, on the first frames' pixels.

    Args:
        first, second: images of one size, both sides a multiple of 16, on one device.

    Returns:
        (B, 3, H, W): u and v in pixels, w in metres of depth; where the first depth is missing, w is 0.
    """
    levels = [build_pyramid(images, len(ITERATIONS)) for images in (first, second)]
    batch, _, height, width = levels[0][-1].depth.shape
    total = first.depth.new_zeros(batch, 3, height, width)
    state = State(total, total[:, :1], total.repeat(1, 2, 1, 1))
    for number, (a, b) in enumerate(zip(reversed(levels[0]), reversed(levels[1]), strict=True)):
        if number:
            # u and v double with the image; the duals go up with the flow.
            scale = total.new_tensor([2, 2, 1])[None, :, None, None]
            total = scale * upsample_flow(total)
            state = State(total, upsample_flow(state.depth_dual), upsample_flow(state.smooth_dual))
        level = linearise(a, b, total[:, :2])
        still = torch.cat([torch.zeros_like(total[:, :2]), total[:, 2:]], 1)
        state = solve(level, state._replace(flow=still), ITERATIONS[number])
        step = state.flow[:, :2].clamp(-_FURTHEST_STEP, _FURTHEST_STEP)
        depth_change = torch.where(a.depth > 0, state.flow[:, 2:], 0.0)
        total = torch.cat([total[:, :2] + step, depth_change], 1)
        total = weighted_median(total, a.depth, level.depth[:, 2:])
    return total


def lift(uvw: Tensor, depth: Tensor, intrinsics: Tensor) -> Tensor:
    """Pixels and depth change (B, 3, H, W) -> scene flow (B, 3, H, W) in metres, given depth and intrinsics (B, 4)."""
    points = torch_pinhole.back_project(depth, intrinsics)
    w = uvw[:, 2:]
    sideways = (depth + w) * uvw[:, :2] / intrinsics[:, :2, None, None]
    return torch.cat([sideways + w * points[:, :2] / depth.clamp(min=1e-6), w], 1)


def _images(frame: RgbdFrame, device: torch.device) -> Images:
    sensible = (frame.depth >= MIN_MEDIAN_DEPTH) & (frame.depth <= MAX_MEDIAN_DEPTH)
    depth = np.where(sensible, frame.depth, np.float32(0))
    gray = matching.gray(frame.color).astype(np.float32)
    return Images(
        gray=torch.from_numpy(gray)[None, None].to(device),
        depth=torch.from_numpy(depth)[None, None].to(device),
        intrinsics=torch_pinhole.intrinsics(frame.camera)[None].to(device),
    )
