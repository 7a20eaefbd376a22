"""The non-rigid step of SR-Flow: a twist for every pixel that explains its window and lies near a smooth field.

Two fields in turn, xi for the data and chi for the smoothness; tau is a twist's translation part, omega its rotation:

    E(xi, chi) = sum_x sum_{x' in the window of x} cost(exp(xi(x)) P(x'))
               + |xi - chi|^2 / (2 kappa) + alpha (TV(tau_chi) + TV(a omega_chi)),    |xi|^2 = |tau|^2 + |a omega|^2

With chi fixed, every pixel has six unknowns of its own: Gauss-Newton on its window. With xi fixed, it is the model of
`smooth` with eta = alpha kappa: channel by channel for tau, vectorial for omega. Every step is taken only where it
lowers E, so that E falls from alternation to alternation.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from objectflow.baselines.sr_flow import smooth, twists
from objectflow.baselines.sr_flow.pyramid import Level
from objectflow.baselines.sr_flow.residuals import Weights, compute_residuals


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
    """The alternation on one level.

    Attributes:
        xi, chi: (B, 6, H, W) the two fields.
        energies: (B,) tensors, E before the first alternation and after each.
    """

    def __init__(self, level: Level, points: Tensor, start: Tensor, settings: LocalSettings) -> None:
        """Start from twists (B, 6, H, W) of points (B, 3, H, W), cm, about the level's pivot."""
        self.level, self.settings = level, settings
        pad = (settings.radius,) * 4
        self.points, self.gray, self.valid = (functional.pad(m, pad) for m in (points, level.gray, level.valid))
        self.scale = start.new_tensor([1.0] * 3 + [settings.arm] * 3).view(1, 6, 1, 1)
        self.coupling = self.scale.square() / settings.kappa
        self.xi = self.chi = start
        self.duals: tuple[Tensor | None, Tensor | None] = (None, None)
        self.cost, self.equations = self._windows(start)
        self.damping = torch.full_like(level.valid, 1e-4)
        self.energies = [self._energy()]

    def run(self) -> Tensor:
        """All alternations; returns chi."""
        for _ in range(self.settings.alternations):
            for _ in range(self.settings.steps):
                self._step()
            self._smooth()
            self.energies.append(self._energy())
        return self.chi

    def _energy(self) -> Tensor:
        tau, omega = _halves(self.scale * self.chi)
        tv = smooth.total_variation(tau, vectorial=False) + smooth.total_variation(omega, vectorial=True)
        return (self.cost + self._pull(self.xi)).sum((1, 2)) + self.settings.alpha * tv

    def _step(self) -> None:
        """One damped Gauss-Newton step (Levenberg-Marquardt) of every pixel, kept where it lowers the energy."""
        right = self.coupling * (self.xi - self.chi)
        trial = self.xi + self.equations.solve(self.coupling, right, self.damping)
        cost, equations = self._windows(trial)
        better = (cost + self._pull(trial) < self.cost + self._pull(self.xi))[:, None]
        self.xi = torch.where(better, trial, self.xi)
        self.cost = torch.where(better[:, 0], cost, self.cost)
        self.equations.take(equations, better)
        self.damping = torch.where(better, self.damping * 0.1, (self.damping * 10).clamp(min=1e-3)).clamp(1e-6, 1e6)

    def _smooth(self) -> None:
        """Smooth both parts; a part stays as it is where its iterations did not reach a lower energy."""
        s = self.settings
        fields = _halves(self.scale * self.chi), _halves(self.scale * self.xi)
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
        self.chi = torch.cat(parts, dim=1) / self.scale
        self.duals = (duals[0], duals[1])

    def _pull(self, twist: Tensor) -> Tensor:
        return ((twist - self.chi).square() * self.coupling).sum(1) / 2

    def _windows(self, twist: Tensor) -> tuple[Tensor, twists.NormalEquations]:
        """Cost (B, H, W) of every window moved by its own twist, and its normal equations."""
        height, width = self.level.gray.shape[2:]
        side = 2 * self.settings.radius + 1
        turn, shift = twists.motions(twist)
        cost = torch.zeros_like(self.level.gray[:, 0])
        equations = twists.NormalEquations(cost)
        for i in range(side):
            for j in range(side):
                there = (..., slice(i, i + height), slice(j, j + width))
                arm = self.points[there] - self.level.pivot
                arm = arm + twists.displace(turn, shift, arm)
                found = compute_residuals(
                    self.level, arm + self.level.pivot, self.gray[there], self.valid[there], self.settings.weights
                )
                cost += found.cost
                for residual, gradient, weight in found.terms:
                    equations.add(residual, twists.jacobian(gradient, arm), weight)
        return cost, equations


def _halves(twist: Tensor) -> tuple[Tensor, Tensor]:
    return twist[:, :3], twist[:, 3:]
