"""The non-rigid step of SR-Flow: a twist for every pixel that explains its window and lies near a smooth field.

Two fields in turn, xi for the data and chi for the smoothness; tau is a twist's translation part, omega its rotation:

    E(xi, chi) = sum_x sum_{x' in the window of x} cost(exp(xi(x)) P(x'))
               + |xi - chi|^2 / (2 kappa) + alpha (TV(tau_chi) + TV(a omega_chi)),    |xi|^2 = |tau|^2 + |a omega|^2

With chi fixed, every pixel has six unknowns of its own: Gauss-Newton on its window. With xi fixed, it is the model of
`smooth` with eta = alpha kappa: channel by channel for tau, vectorial for omega. Every step is taken only where it
lowers E, so that E falls from alternation to alternation; and a window is looked at only where the step is worth it.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from objectflow.methods.baselines.sr_flow import smooth, twists
from objectflow.methods.baselines.sr_flow.pyramid import Level
from objectflow.methods.baselines.sr_flow.residuals import Weights, compute_residuals

STEP_BELOW = 1e-3
"""Centimetres, a rotation counting by its arm: a pixel whose step would be smaller stays until chi has moved."""

CHUNK = 2048
"""Pixels whose windows are taken at a time on the CPU: what they need fits into a core's own cache."""


@dataclass(frozen=True)
class LocalSettings:
    """What the alternation on a level takes.

    Attributes:
        weights: of the data terms.
        alternations: of Gauss-Newton and smoothing.
        steps: Gauss-Newton steps in each.
        smoothing_steps: dual steps in each.
        radius: windows are 2 radius + 1 pixels wide.
        alpha: weight of the total variation.
        kappa: looseness of the coupling, cm^2.
        arm: a, cm: how far from an axis a point must lie for its rotation to weigh as much as its translation.
    """

    weights: Weights
    alternations: int
    steps: int
    smoothing_steps: int
    radius: int
    alpha: float
    kappa: float
    arm: float


class LocalSolver:
    """The alternation on one level, for one pair.

    Pixels that have come to rest cost nothing, which is most of them after a few steps: maps are lists of N = H W
    pixels here, so that some of them can be taken.

    Attributes:
        xi, chi: (6, N) the two fields.
        energies: () tensors, E before the first alternation and after each.
    """

    def __init__(self, level: Level, points: Tensor, start: Tensor, settings: LocalSettings) -> None:
        """Start from twists (1, 6, H, W) of points (1, 3, H, W), cm, about the level's pivot."""
        self.level, self.settings = level, settings
        self.height, self.width = level.gray.shape[2:]
        padded = functional.pad(torch.cat([points - level.pivot, level.gray, level.valid], 1), (settings.radius,) * 4)
        self.first = padded[0].flatten(1)
        """Arm, intensity and validity of each pixel, (5, ...) with a border: windows are looked up here."""
        places = torch.arange(self.first.shape[1], device=start.device).view(padded.shape[2:])
        self.corners = places[: self.height, : self.width].flatten()
        side = 2 * settings.radius + 1
        self.offsets = places[:side, :side].reshape(-1, 1)
        self.scale = start.new_tensor([1.0] * 3 + [settings.arm] * 3)[:, None]
        self.coupling = self.scale.square() / settings.kappa
        self.chi = start[0].flatten(1)
        self.xi = self.chi.clone()
        self.duals: tuple[Tensor | None, Tensor | None] = (None, None)
        self.everywhere = torch.arange(self.xi.shape[1], device=start.device)
        self.cost, self.equations = self._windows(self.everywhere, self.xi)
        self.damping = torch.full_like(self.cost, 1e-4)
        self.energies = [self._energy()]

    def run(self) -> Tensor:
        """All alternations; returns chi, (1, 6, H, W)."""
        for _ in range(self.settings.alternations):
            pixels = self.everywhere
            for _ in range(self.settings.steps):
                pixels = self._step(pixels)
            self._smooth()
            self.energies.append(self._energy())
        return self._map(self.chi)

    def _map(self, field: Tensor) -> Tensor:
        return field.view(1, -1, self.height, self.width)

    def _energy(self) -> Tensor:
        tau, omega = _halves(self._map(self.scale * self.chi))
        tv = smooth.total_variation(tau, vectorial=False) + smooth.total_variation(omega, vectorial=True)
        return (self.cost + self._pull(self.xi - self.chi)).sum() + self.settings.alpha * tv[0]

    def _step(self, pixels: Tensor) -> Tensor:
        """One damped Gauss-Newton step (Levenberg-Marquardt) of some pixels, kept where it lowers the energy.

        Returns those of them that are not at rest.
        """
        apart = (self.xi - self.chi).index_select(1, pixels)
        equations = self.equations if pixels is self.everywhere else self.equations.index_select(1, pixels)
        step = twists.solve(equations, self.coupling, self.coupling * apart, self.damping[pixels])
        restless = ((self.scale * step).abs().amax(0) > STEP_BELOW).nonzero()[:, 0]
        pixels, apart, step = pixels[restless], apart[:, restless], step[:, restless]
        trial = self.xi[:, pixels] + step
        cost, equations = self._windows(pixels, trial)
        better = cost + self._pull(apart + step) < self.cost[pixels] + self._pull(apart)
        damping = self.damping[pixels]
        self.damping[pixels] = torch.where(better, damping * 0.1, (damping * 10).clamp(min=1e-3)).clamp(1e-6, 1e6)
        lower = better.nonzero()[:, 0]
        taken = pixels[lower]
        self.cost[taken] = cost[lower]
        for kept, found in ((self.xi, trial), (self.equations, equations)):
            kept.index_copy_(1, taken, found.index_select(1, lower))
        return pixels

    def _smooth(self) -> None:
        """Smooth both parts; a part stays as it is where its iterations did not reach a lower energy."""
        s = self.settings
        fields = (_halves(self._map(self.scale * field)) for field in (self.chi, self.xi))
        parts, duals = [], []
        for old, target, vectorial, start in zip(*fields, (False, True), self.duals, strict=True):
            new, dual = smooth.smooth(target, s.alpha * s.kappa, s.smoothing_steps, vectorial=vectorial, dual=start)
            energies = [
                (field - target).square().sum((1, 2, 3)) / (2 * s.kappa)
                + s.alpha * smooth.total_variation(field, vectorial=vectorial)
                for field in (old, new)
            ]
            parts.append(torch.where((energies[1] < energies[0]).view(-1, 1, 1, 1), new, old))
            duals.append(dual)
        self.chi = torch.cat(parts, dim=1)[0].flatten(1) / self.scale
        self.duals = (duals[0], duals[1])

    def _pull(self, apart: Tensor) -> Tensor:
        return (apart.square() * self.coupling).sum(0) / 2

    def _windows(self, pixels: Tensor, twist: Tensor) -> tuple[Tensor, Tensor]:
        """Cost (n,) of the windows of n pixels, moved by their twists (6, n), and their normal equations (27, n)."""
        chunk = CHUNK if twist.device.type == "cpu" else max(1, len(pixels))
        costs, equations = [], []
        for some, moving in zip(torch.split(pixels, chunk), torch.split(twist, chunk, dim=1), strict=True):
            turn, shift = twists.motions(moving[None, :, None])
            near = self.first.index_select(1, (self.corners[some] + self.offsets).flatten())
            near = near.view(1, 5, len(self.offsets), len(some))
            arm = near[:, :3]
            arm = arm + twists.displace(turn, shift, arm)
            moved = arm + self.level.pivot
            found = compute_residuals(self.level, moved, near[:, 3:4], near[:, 4:], self.settings.weights)
            costs.append(found.cost[0].sum(0))
            of_terms = [twists.normal_equations(r[0], twists.jacobian(g, arm)[0], w[0]) for r, g, w in found.terms]
            equations.append(of_terms[0] + of_terms[1])
        return torch.cat(costs), torch.cat(equations, dim=1)


def _halves(twist: Tensor) -> tuple[Tensor, Tensor]:
    return twist[:, :3], twist[:, 3:]
