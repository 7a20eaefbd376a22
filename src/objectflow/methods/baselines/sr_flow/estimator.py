"""`sr-flow`: dense semi-rigid scene flow (Quiroga, Brox, Devernay and Crowley, ECCV 2014), written from the paper.

Every pixel has a twist xi of six parameters. The data term compares the intensity and depth of the moved window with
the second frame (`residuals`, equations 6 and 7); the smoothness term makes the twist field piecewise constant, as for
rigid bodies (`smooth`, equation 16). The two are minimised alternately (`local`) from coarse to fine (`pyramid`). A
camera motion is a rigid motion of the whole scene, estimated first on each level (`rigid`). The flow is
(exp(xi) - I) P.

Differences from the authors' program:
- The working width is 320 pixels, not 640, the size of the project's data.
- Twists rotate about the mean point of the scene, and rotations are weighted as displacements at a lever arm of 10 cm.
  The program rotates about the camera and scales the coupling of rotations down by 1000, so that lateral translations
  can be explained by rotations about the camera at no cost and the minimum is a featureless rotation field.
- alpha is 1, not 10: 10 suppresses motions below 1 cm in this energy; `benchmarks/small_motions.py` compares the two.
- Pixels whose Gauss-Newton step is below 10 micrometres are skipped, which saves most of the computation.
- Gauss-Newton steps are damped and rejected where they increase the energy, outliers have a constant cost instead of
  none, and the dual of the smoothing is kept between alternations, so the energy decreases monotonically.
- The rigid motion is estimated without the local field, which would otherwise absorb it.
- All depths are used; the program ignores depth outside 0.5 to 1.0 m.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from objectflow.alignment.frame_pair import FramePair
from objectflow.frame import RgbdFrame
from objectflow.geometry import torch_pinhole
from objectflow.methods.base import PairEstimator
from objectflow.methods.baselines.sr_flow import local, twists
from objectflow.methods.baselines.sr_flow.pyramid import CENTIMETRES, build_pyramid
from objectflow.methods.baselines.sr_flow.residuals import Weights
from objectflow.methods.baselines.sr_flow.rigid import apply_rigid, solve_rigid
from objectflow.motion import SceneMotion
from objectflow.runtime.devices import find_device
from objectflow.settings import Settings, setting
from objectflow.typing import Float64Array


@dataclass(frozen=True, eq=False)
class Solution:
    """The solution at the working resolution.

    Attributes:
        motion: (B, 4, 4) float64, the rigid part: `prev_T_curr` of points relative to the pivot, cm.
        twist: (B, 6, H, W) the local part, applied after the rigid part.
        pivot: (B, 3, 1, 1) cm.
        energies: for each level, coarse to fine, the energy (B,) before the first alternation and after each.
        rigid_costs: for each level, the cost of the rigid step before the first iteration and after each.
    """

    motion: Tensor
    twist: Tensor
    pivot: Tensor
    energies: list[list[Tensor]]
    rigid_costs: list[list[Tensor]]


@dataclass(frozen=True)
class SRFlow(Settings, PairEstimator):
    """Semi-rigid scene flow; flow only, no objects."""

    camera: Literal["auto", "static", "moving"] = "auto"
    """moving selects the semi-rigid mode; otherwise a camera motion is part of the flow."""
    mode: Literal["auto", "non-rigid", "rigid", "semi-rigid"] = "auto"
    """non-rigid: a twist per pixel. rigid: one motion. semi-rigid: both. auto: by `camera`."""
    device: str = "auto"
    """auto, cpu, cuda or cuda:N."""
    width: int = setting(320, minimum=1)
    """Pixels: wider images are downscaled to it."""
    levels: int = setting(3, minimum=1)
    """Maximum number of pyramid levels."""
    alternations: int = setting(5, minimum=1)
    """Alternations between the local and the rigid step on each level."""
    steps: int = setting(5, minimum=1)
    """Iterations of the local step."""
    smoothing_steps: int = setting(50, minimum=1)
    """Iterations of the smoothing step."""
    rigid_steps: int = setting(100, minimum=1)
    """Maximum number of iterations of the rigid step."""
    radius: int = setting(2, minimum=1)
    """Pixels: windows are 2 radius + 1 wide."""
    intensity_weight: float = setting(1.0, above=0, below=1e6)
    """Weight of the intensity residual; see `local`."""
    depth_weight: float = setting(0.1, above=0, below=1e6)
    """Weight of the depth residual; see `local`."""
    alpha: float = setting(1.0, above=0, below=1e6)
    """Weight of the regularisation; see `local`."""
    kappa: float = setting(0.05, above=0, below=1e6)
    """See `local`."""
    arm: float = setting(10.0, above=0, below=1e6)
    """Centimetres: lever arm that relates rotations to translations; see `local`."""

    def __post_init__(self) -> None:
        super().__post_init__()
        find_device(self.device)

    def estimate(self, pair: FramePair) -> SceneMotion:
        """See `PairEstimator`."""
        start = time.perf_counter()
        prev, curr = pair.prev.frame, pair.curr.frame
        solution = self.solve(prev, curr)
        points = torch.from_numpy(pair.curr.points).to(solution.twist).movedim(-1, 0)[None]
        twist = functional.interpolate(solution.twist, points.shape[2:], mode="bilinear")
        arm = points * CENTIMETRES - solution.pivot
        rigid = solution.motion.to(arm.dtype)
        eye = torch.eye(3, dtype=arm.dtype, device=arm.device)
        flow = twists.displace((rigid[:, :3, :3] - eye)[..., None, None], rigid[:, :3, 3, None, None], arm)
        flow = flow + twists.displace(*twists.motions(twist), arm + flow)
        return SceneMotion(
            labels=np.zeros(curr.depth.shape, np.int32),
            scene_flow=(flow / CENTIMETRES)[0].movedim(0, -1).contiguous().cpu().numpy(),
            camera_motion=None if self._mode() == "non-rigid" else _camera_motion(solution),
            method="sr-flow",
            seconds=time.perf_counter() - start,
        )

    def solve(self, prev: RgbdFrame, curr: RgbdFrame) -> Solution:
        """Compute the twists of `curr`'s pixels at the working resolution."""
        width = min(self.width, curr.camera.width)
        height = max(1, round(curr.camera.height * width / curr.camera.width))
        prev, curr = prev.resized(width, height), curr.resized(width, height)
        device = find_device(self.device)
        intrinsics = torch_pinhole.intrinsics(curr.camera)[None].to(device)
        return self.solve_tensors(frame_tensors(curr, device), frame_tensors(prev, device), intrinsics)

    @torch.no_grad()
    def solve_tensors(self, curr: tuple[Tensor, Tensor], prev: tuple[Tensor, Tensor], intrinsics: Tensor) -> Solution:
        """Solve a batch: colour (B, 3, H, W) in 0..1, depth (B, 1, H, W) in metres, intrinsics (B, 4) in pixels."""
        levels = build_pyramid(curr, prev, intrinsics, self.levels)
        batch, kind = len(intrinsics), levels[0].points
        motion = torch.eye(4, dtype=torch.float64, device=kind.device).repeat(batch, 1, 1)
        twist = kind.new_zeros(batch, 6, *levels[-1].gray.shape[2:])
        energies, rigid_costs = [], []
        weights = Weights(self.intensity_weight, self.depth_weight)
        for level in reversed(levels):
            twist = functional.interpolate(twist, level.gray.shape[2:], mode="bilinear")
            if self._mode() != "non-rigid":
                motion, costs = solve_rigid(level, motion, self.rigid_steps, weights)
                rigid_costs.append(costs)
            if self._mode() != "rigid":
                solvers = [
                    local.LocalSolver(level.item(k), points[None], start[None], self._local_settings(weights))
                    for k, (points, start) in enumerate(zip(apply_rigid(level, motion), twist, strict=True))
                ]
                twist = torch.cat([solver.run() for solver in solvers])
                energies.append([torch.stack(values) for values in zip(*(s.energies for s in solvers), strict=True)])
        return Solution(motion, twist, levels[0].pivot, energies, rigid_costs)

    def _mode(self) -> str:
        if self.mode != "auto":
            return self.mode
        return "semi-rigid" if self.camera == "moving" else "non-rigid"

    def _local_settings(self, weights: Weights) -> local.LocalSettings:
        return local.LocalSettings(
            weights=weights,
            alternations=self.alternations,
            steps=self.steps,
            smoothing_steps=self.smoothing_steps,
            radius=self.radius,
            alpha=self.alpha,
            kappa=self.kappa,
            arm=self.arm,
        )


def frame_tensors(frame: RgbdFrame, device: torch.device) -> tuple[Tensor, Tensor]:
    """Colour (1, 3, H, W) in 0..1 and depth (1, 1, H, W) in metres of a frame."""
    color = torch.from_numpy(frame.color).to(device).movedim(-1, 0)[None].float() / 255
    return color, torch.from_numpy(frame.depth).to(device)[None, None]


def _camera_motion(solution: Solution) -> Float64Array:
    """(4, 4) `prev_T_curr` in metres, in the camera frame."""
    motion = solution.motion[0].cpu().numpy().copy()
    pivot = solution.pivot[0, :, 0, 0].cpu().numpy().astype(np.float64)
    motion[:3, 3] = (motion[:3, 3] + pivot - motion[:3, :3] @ pivot) / CENTIMETRES
    return np.asarray(motion)
