"""Registration of one object under many hypotheses at once: `registration.refine` as one array program."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from objectflow import geometry
from objectflow.alignment.batch_target import BatchPixels, BatchSource, BatchTarget, inverse_depth
from objectflow.alignment.registration import RegistrationSettings
from objectflow.typing import Float32Array, Float64Array

DEFAULTS = RegistrationSettings()

_MAX_TURN = 0.35
"""Radians: largest rotation of one step; a longer one leaves the range in which the equations are linear."""


def refine_batch(
    target: BatchTarget,
    source: BatchSource,
    rotations: Float64Array,
    positions: Float64Array,
    iterations: Sequence[int],
    settings: RegistrationSettings = DEFAULTS,
) -> tuple[Float64Array, Float64Array]:
    """Projective point-to-plane ICP with a colour term, from many initial motions.

    It minimises what `registration.refine` does, without matches. Two things are simpler, as medians would cost more
    than all else: the change of exposure is the mean of the grey residuals, and their standard deviation follows from
    their mean absolute value.

    Args:
        target: the previous frame.
        source: the object's points.
        rotations: (K, 3, 3) initial `prev_R_curr`.
        positions: (K, 3) metres: initial positions of the points' centre in the previous frame.
        iterations: number of Gauss-Newton steps for each blur of the grey images.
        settings: gates and weights; the numbers of iterations and `min_step` do not apply.

    Returns:
        Rotations and positions, as given.
    """
    rotations, positions = np.asarray(rotations, dtype=np.float64), np.asarray(positions, dtype=np.float64)
    done = 0
    for level, count in enumerate(iterations):
        for _ in range(count):
            gate = max(settings.first_gate * settings.gate_decay**done, settings.last_gate)
            H, b = _normal_equations(target, source, level, rotations, positions, gate, settings)
            diagonal = np.einsum("kii->ki", H)
            H[:, range(6), range(6)] += 1e-4 * diagonal + 1e-6 * diagonal.sum(axis=1, keepdims=True) / 6 + 1e-6
            step = np.linalg.solve(H, -b[..., None])[..., 0]
            step *= np.minimum(1, _MAX_TURN / np.maximum(np.abs(step[:, 3:]).max(axis=1, keepdims=True), 1e-9))
            rotations, positions = geometry.so3_exp(step[:, 3:]) @ rotations, positions + step[:, :3]
            done += 1
    return rotations, positions


def _normal_equations(
    target: BatchTarget,
    source: BatchSource,
    level: int,
    rotations: Float64Array,
    positions: Float64Array,
    gate: float,
    settings: RegistrationSettings,
) -> tuple[Float64Array, Float64Array]:
    """(K, 6, 6) and (K, 6): the systems of the depth and the colour terms, for a rotation about the moved centre."""
    turned = rotations.astype(np.float32) @ source.points
    points = turned + positions.astype(np.float32)[..., None]
    inverse = inverse_depth(points)
    pixels = BatchPixels.of(points, inverse, target.camera)
    column, row = (pixels.u + np.float32(0.5)).astype(np.int32), (pixels.v + np.float32(0.5)).astype(np.int32)
    cell = row * np.int32(target.camera.width) + column
    x, y, z, *normal = (values.take(cell) for values in target.surface)
    offset = [points[:, 0] - x, points[:, 1] - y, points[:, 2] - z]
    along = offset[0] * normal[0] + offset[1] * normal[1] + offset[2] * normal[2]
    sigma = target.noise.sigma(points[:, 2])
    used = pixels.inside & (np.abs(offset[2]) < np.float32(gate) + np.float32(settings.inlier_sigmas) * sigma)
    used &= np.isfinite(along)

    count, number = len(rotations), source.points.shape[1]
    # Both terms side by side, filled in place.
    J, r = np.empty((count, 6, 2 * number), np.float32), np.empty((count, 2 * number), np.float32)
    depth, color = slice(0, number), slice(number, None)
    weight = np.where(used, np.float32(1) / sigma, np.float32(0))
    for k in range(3):
        normal[k][~used] = 0
        np.multiply(normal[k], weight, out=J[:, k, depth])
    along[~used] = 0
    np.multiply(along, weight, out=r[:, depth])

    gray, along_u, along_v = (values.take(cell) for values in target.shades[level])
    # To first order about the nearest pixel; bilinear interpolation would take four gathers.
    difference = gray + along_u * (pixels.u - column) + along_v * (pixels.v - row) - source.grays[level]
    seen = used.sum(axis=1, keepdims=True, dtype=np.float32) + np.float32(1e-6)
    difference -= (difference * used).sum(axis=1, keepdims=True) / seen  # exposure may have changed
    difference *= used
    noise = np.float32(1.2533) * np.abs(difference).sum(axis=1, keepdims=True) / seen  # of a normal distribution
    weight = used / np.maximum(noise, np.float32(settings.min_gray_noise))
    np.multiply(difference, weight, out=r[:, color])
    weight *= inverse
    a = along_u * weight * np.float32(target.camera.fx)
    b = along_v * weight * np.float32(target.camera.fy)
    J[:, 0, color], J[:, 1, color], J[:, 2, color] = a, b, -(a * points[:, 0] + b * points[:, 1]) * inverse
    for term in (depth, color):
        _cross(turned, J[:, :3, term], J[:, 3:, term])
    weights = r * r
    weights *= np.float32(-1 / settings.tukey**2)
    weights += np.float32(1)
    np.maximum(weights, 0, out=weights)
    weights *= weights
    weights[:, color] *= np.float32(settings.color_weight)
    weighted = J * weights[:, None]
    return (weighted @ J.transpose(0, 2, 1)).astype(np.float64), (weighted @ r[..., None])[..., 0].astype(np.float64)


def _cross(a: Float32Array, b: Float32Array, out: Float32Array) -> None:
    """(K, 3, N) x (K, 3, N), written to `out`."""
    x, y, z = a[:, 0], a[:, 1], a[:, 2]
    u, v, w = b[:, 0], b[:, 1], b[:, 2]
    np.subtract(y * w, z * v, out=out[:, 0])
    np.subtract(z * u, x * w, out=out[:, 1])
    np.subtract(x * v, y * u, out=out[:, 2])
