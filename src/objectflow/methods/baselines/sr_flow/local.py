"""The non-rigid step of SR-Flow: a twist per pixel that fits its window and is coupled to a smooth field.

Alternates between two fields, xi for the data and chi for the smoothness; tau is a twist's translation, omega its
rotation:

    E(xi, chi) = sum_x sum_{x' in the window of x} cost(exp(xi(x)) P(x'))
               + |xi - chi|^2 / (2 kappa) + alpha (TV(tau_chi) + TV(a omega_chi)),    |xi|^2 = |tau|^2 + |a omega|^2

With chi fixed, the six unknowns of each pixel are independent and solved by Gauss-Newton on its window. With xi fixed,
it is the model of `smooth` with eta = alpha kappa: per channel for tau, vectorial for omega. Steps are accepted only
where they lower E, so E decreases at every alternation. Windows are evaluated only where the step is not negligible.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from objectflow.methods.baselines.sr_flow import smooth, twists
from objectflow.methods.baselines.sr_flow.pyramid import Level
from objectflow.methods.baselines.sr_flow.residuals import Weights, compute_residuals

MIN_STEP = 1e-3
"""Smallest step that is evaluated, cm, with rotations scaled by the arm; smaller steps wait for a change of chi."""

CHUNK = 2048
"""Number of pixels per chunk on the CPU, whose windows fit into a core's cache."""


@dataclass(frozen=True)
class LocalSettings:
    """Settings of the alternation on a level.

    Attributes:
        weights: of the data terms.
        alternations: number of alternations between Gauss-Newton and smoothing.
        steps: Gauss-Newton steps per alternation.
        smoothing_steps: dual steps per alternation.
        radius: windows are 2 radius + 1 pixels wide.
        alpha: weight of the total variation.
        kappa: variance of the coupling of the two fields, cm^2.
        arm: a, lever arm at which rotations are weighted like translations, cm.
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

    Converged pixels are skipped, which are most of them after a few steps. Maps are therefore stored as lists of
    N = H W pixels, from which subsets are selected.

    Attributes:
        xi, chi: (6, N) the two fields.
        energies: () tensors, E before the first alternation and after each.
    """

    def __init__(self, level: Level, points: Tensor, start: Tensor, settings: LocalSettings) -> None:
        """Start from twists (1, 6, H, W), about the level's pivot, of points (1, 3, H, W) in cm."""
        self.level, self.settings = level, settings
        self.height, self.width = level.gray.shape[2:]
        padded = functional.pad(torch.cat([points - level.pivot, level.gray, level.valid], 1), (settings.radius,) * 4)
        self.first = padded[0].flatten(1)
        """(5, ...) arm, intensity and validity of the padded pixels, from which windows are gathered."""
        indices = torch.arange(self.first.shape[1], device=start.device).view(padded.shape[2:])
        self.corners = indices[: self.height, : self.width].flatten()
        side = 2 * settings.radius + 1
        self.offsets = indices[:side, :side].reshape(-1, 1)
        self.scale = start.new_tensor([1.0] * 3 + [settings.arm] * 3)[:, None]
        self.coupling = self.scale.square() / settings.kappa
        self.chi = start[0].flatten(1)
        self.xi = self.chi.clone()
        self.duals: tuple[Tensor | None, Tensor | None] = (None, None)
        self.all_pixels = torch.arange(self.xi.shape[1], device=start.device)
        self.cost, self.equations = self._linearise(self.all_pixels, self.xi)
        self.damping = torch.full_like(self.cost, 1e-4)
        self.energies = [self._energy()]

    def run(self) -> Tensor:
        """Run all alternations and return chi, (1, 6, H, W)."""
        for _ in range(self.settings.alternations):
            pixels = self.all_pixels
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
        return (self.cost + self._coupling_cost(self.xi - self.chi)).sum() + self.settings.alpha * tv[0]

    def _step(self, pixels: Tensor) -> Tensor:
        """One Levenberg-Marquardt step of some pixels, accepted where it lowers the energy.

        Returns the pixels that have not converged.
        """
        difference = (self.xi - self.chi).index_select(1, pixels)
        equations = self.equations if pixels is self.all_pixels else self.equations.index_select(1, pixels)
        step = twists.solve(equations, self.coupling, self.coupling * difference, self.damping[pixels])
        active = ((self.scale * step).abs().amax(0) > MIN_STEP).nonzero()[:, 0]
        pixels, difference, step = pixels[active], difference[:, active], step[:, active]
        trial = self.xi[:, pixels] + step
        cost, equations = self._linearise(pixels, trial)
        new_energy = cost + self._coupling_cost(difference + step)
        better = new_energy < self.cost[pixels] + self._coupling_cost(difference)
        damping = self.damping[pixels]
        self.damping[pixels] = torch.where(better, damping * 0.1, (damping * 10).clamp(min=1e-3)).clamp(1e-6, 1e6)
        accepted = better.nonzero()[:, 0]
        updated = pixels[accepted]
        self.cost[updated] = cost[accepted]
        for stored, new in ((self.xi, trial), (self.equations, equations)):
            stored.index_copy_(1, updated, new.index_select(1, accepted))
        return pixels

    def _smooth(self) -> None:
        """Smooth both parts of chi; a part is kept unchanged if the iterations did not lower its energy."""
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

    def _coupling_cost(self, difference: Tensor) -> Tensor:
        return (difference.square() * self.coupling).sum(0) / 2

    def _linearise(self, pixels: Tensor, twist: Tensor) -> tuple[Tensor, Tensor]:
        """Costs (n,) of the windows of n pixels moved by their twists (6, n), and their normal equations (27, n)."""
        chunk_size = CHUNK if twist.device.type == "cpu" else max(1, len(pixels))
        costs, equations = [], []
        for chunk, chunk_twist in zip(
            torch.split(pixels, chunk_size), torch.split(twist, chunk_size, dim=1), strict=True
        ):
            rotation, shift = twists.motions(chunk_twist[None, :, None])
            window = self.first.index_select(1, (self.corners[chunk] + self.offsets).flatten())
            window = window.view(1, 5, len(self.offsets), len(chunk))
            arm = window[:, :3]
            arm = arm + twists.displace(rotation, shift, arm)
            moved = arm + self.level.pivot
            residuals = compute_residuals(self.level, moved, window[:, 3:4], window[:, 4:], self.settings.weights)
            costs.append(residuals.cost[0].sum(0))
            systems = [twists.normal_equations(r[0], twists.jacobian(g, arm)[0], w[0]) for r, g, w in residuals.terms]
            equations.append(systems[0] + systems[1])
        return torch.cat(costs), torch.cat(equations, dim=1)


def _halves(twist: Tensor) -> tuple[Tensor, Tensor]:
    return twist[:, :3], twist[:, 3:]
