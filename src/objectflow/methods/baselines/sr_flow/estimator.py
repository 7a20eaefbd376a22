"""`sr-flow`: dense semi-rigid scene flow (Quiroga, Brox, Devernay and Crowley, ECCV 2014), written from the paper.

Every pixel has a twist, six numbers. It should explain the intensity and the depth of its window in the other frame
(`residuals`, equations 6 and 7), and the field of twists should be piecewise constant, as it is where rigid bodies
move (`smooth`, equation 16). The two are solved in turn (`local`) from coarse to fine (`pyramid`). A camera that
moves is a rigid motion of everything, found first on each level (`rigid`). The flow is (exp(xi) - I) P.

What differs from the authors' program, and why:
- Pictures are worked on at a width of 320 pixels, not 640: the project's data has that size.
- Twists turn about the mean point of the scene and rotations count as displacements at an arm of 10 cm, where the
  program turns about the camera and loosens rotations by a factor of 1000. There every sideways step passed for a
  rotation about the camera, free of charge, and the minimum of the energy is a rotation field without features.
- alpha is 1, not 10, in this energy: 10 holds motions of less than a centimetre back;
  `benchmarks/small_motions.py` compares the two.
- A pixel whose Gauss-Newton step would be less than 10 micrometres does not take it, which spares most windows.
- Gauss-Newton steps are damped and undone where they raise the energy, outliers pay a constant and not nothing, and
  the dual of the smoothing is kept between alternations. So the energy falls at every alternation.
- The rigid motion is found without the local field, whose smooth part would take its place bit by bit.
- The whole range of depth is used, where the program ignores what lies outside 0.5 to 1.0 m.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from objectflow import geometry
from objectflow.errors import MethodError
from objectflow.frame import RgbdFrame, check_pair
from objectflow.geometry import torch_pinhole
from objectflow.methods.base import check_camera_option
from objectflow.methods.baselines.sr_flow import local, twists
from objectflow.methods.baselines.sr_flow.pyramid import CENTIMETRES, build_pyramid
from objectflow.methods.baselines.sr_flow.residuals import Weights
from objectflow.methods.baselines.sr_flow.rigid import apply_rigid, solve_rigid
from objectflow.motion import SceneMotion
from objectflow.runtime.devices import find_device
from objectflow.typing import Float64Array

MODES = ("auto", "non-rigid", "rigid", "semi-rigid")


@dataclass(frozen=True, eq=False)
class Solution:
    """What the method found at its own resolution.

    Attributes:
        motion: (B, 4, 4) float64, the rigid part: `prev_T_curr` of arms from the pivot, cm.
        twist: (B, 6, H, W) the local part, which follows it.
        pivot: (B, 3, 1, 1) cm.
        energies: for each level, coarse to fine, the energy (B,) before the first alternation and after each.
        rigid_costs: for each level, the rigid step's cost before the first iteration and after each.
    """

    motion: Tensor
    twist: Tensor
    pivot: Tensor
    energies: list[list[Tensor]]
    rigid_costs: list[list[Tensor]]


@dataclass(frozen=True)
class SRFlow:
    """Semi-rigid scene flow; flow only, no objects.

    Attributes:
        camera: "moving" asks for the semi-rigid mode; otherwise a camera's motion is simply part of the flow.
        mode: "non-rigid" (a twist a pixel), "rigid" (one motion for all), "semi-rigid" (both) or "auto" (by `camera`).
        device: where to compute: "auto", "cpu", "cuda" or "cuda:N".
        width: pixels; wider pictures are worked on at this width.
        levels: of the pyramid.
        alternations, steps, smoothing_steps, rigid_steps: iterations on each level.
        radius: windows are 2 radius + 1 pixels wide.
        intensity_weight, depth_weight, alpha, kappa, arm: see `local`.

    Raises:
        MethodError: an option without meaning, or a device that is not there.
    """

    camera: str = "auto"
    mode: str = "auto"
    device: str = "auto"
    width: int = 320
    levels: int = 3
    alternations: int = 5
    steps: int = 5
    smoothing_steps: int = 50
    rigid_steps: int = 100
    radius: int = 2
    intensity_weight: float = 1.0
    depth_weight: float = 0.1
    alpha: float = 1.0
    kappa: float = 0.05
    arm: float = 10.0

    def __post_init__(self) -> None:
        check_camera_option(self.camera)
        if self.mode not in MODES:
            raise MethodError(f"mode must be one of {', '.join(MODES)}, not {self.mode!r}")
        for name in ("width", "levels", "alternations", "steps", "smoothing_steps", "rigid_steps", "radius"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int) or value < 1:
                raise MethodError(f"{name} must be a whole number from 1, not {value!r}")
        for name in ("intensity_weight", "depth_weight", "alpha", "kappa", "arm"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, (int, float)) or not 0 < value < 1e6:
                raise MethodError(f"{name} must be a positive number, not {value!r}")
        find_device(self.device)

    def __call__(self, prev: RgbdFrame, curr: RgbdFrame) -> SceneMotion:
        """See `Estimator`."""
        start = time.perf_counter()
        check_pair(prev, curr)
        solution = self.solve(prev, curr)
        points = (
            torch.from_numpy(geometry.back_project(curr.depth, curr.camera)).to(solution.twist).movedim(-1, 0)[None]
        )
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
        """Twists of `curr`'s pixels at the method's own resolution, and how the energy fell."""
        width = min(self.width, curr.camera.width)
        height = max(1, round(curr.camera.height * width / curr.camera.width))
        prev, curr = prev.resized(width, height), curr.resized(width, height)
        device = find_device(self.device)
        intrinsics = torch_pinhole.intrinsics(curr.camera)[None].to(device)
        return self.solve_tensors(_tensors(curr, device), _tensors(prev, device), intrinsics)

    @torch.no_grad()
    def solve_tensors(self, curr: tuple[Tensor, Tensor], prev: tuple[Tensor, Tensor], intrinsics: Tensor) -> Solution:
        """The method itself, batched: colour (B, 3, H, W) in 0..1, depth (B, 1, H, W) in metres, intrinsics (B, 4)."""
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


def _tensors(frame: RgbdFrame, device: torch.device) -> tuple[Tensor, Tensor]:
    color = torch.from_numpy(frame.color).to(device).movedim(-1, 0)[None].float() / 255
    return color, torch.from_numpy(frame.depth).to(device)[None, None]


def _camera_motion(solution: Solution) -> Float64Array:
    """(4, 4) `prev_T_curr` in metres, about the camera's centre."""
    motion = solution.motion[0].cpu().numpy().copy()
    pivot = solution.pivot[0, :, 0, 0].cpu().numpy().astype(np.float64)
    motion[:3, 3] = (motion[:3, 3] + pivot - motion[:3, :3] @ pivot) / CENTIMETRES
    return np.asarray(motion)
