"""How badly each of many motions fits the points of one object: `likelihood.motion_cost` as one array program."""

from __future__ import annotations

import numpy as np

from objectflow.alignment.batch_target import BatchPixels, BatchSource, BatchTarget, inverse_depth
from objectflow.alignment.likelihood import LikelihoodSettings
from objectflow.typing import Float32Array, Float64Array

DEFAULTS = LikelihoodSettings()


def batch_cost(
    target: BatchTarget,
    source: BatchSource,
    rotations: Float64Array,
    positions: Float64Array,
    *,
    out_of_view: float,
    settings: LikelihoodSettings = DEFAULTS,
) -> Float32Array:
    """Cost of each point under each motion, as `likelihood.motion_cost` with colours of the nearest pixels.

    Args:
        target: the previous frame.
        source: the object's points.
        rotations: (K, 3, 3) `prev_R_curr`.
        positions: (K, 3) metres: positions of the points' centre in the previous frame.
        out_of_view: cost of points that the previous frame does not show.
        settings: the other costs.

    Returns:
        (K, N) float32.
    """
    points = rotations.astype(np.float32) @ source.points + positions.astype(np.float32)[..., None]
    depth, width = points[:, 2], np.int32(target.camera.width)
    pixels = BatchPixels.of(points, inverse_depth(points), target.camera)
    first = pixels.v.astype(np.int32) * width + pixels.u.astype(np.int32)
    offset = depth - target.depth.take(first)
    distance = np.abs(offset)
    # The best of the four neighbours: at a depth edge, interpolated depth would lie on neither surface.
    for step in (np.int32(1), width, width + np.int32(1)):
        other = depth - target.depth.take(first + step)
        closer = np.abs(other) < distance
        np.copyto(offset, other, where=closer)
        np.copyto(distance, np.abs(other), where=closer)
    known = pixels.inside & np.isfinite(offset)
    sigma = np.float32(settings.noise_factor) * target.noise.sigma(depth) + np.float32(settings.extra_noise)
    scaled = offset / sigma
    cost = np.minimum(scaled * scaled, np.float32(settings.outlier_sigmas**2)) * np.float32(0.5)
    cost += _color_cost(target, source, pixels, settings)
    worst = np.float32(settings.free_space_violation)
    np.copyto(
        cost, np.float32(out_of_view) + (scaled < settings.far_behind_sigmas), where=scaled > settings.hidden_sigmas
    )
    np.copyto(cost, worst, where=scaled < -settings.outlier_sigmas)
    np.minimum(cost, worst, out=cost)
    cost[~known] = out_of_view
    return np.asarray(cost)


def _color_cost(
    target: BatchTarget, source: BatchSource, pixels: BatchPixels, settings: LikelihoodSettings
) -> Float32Array:
    half = np.float32(0.5)
    cell = (pixels.v + half).astype(np.int32) * np.int32(target.camera.width) + (pixels.u + half).astype(np.int32)
    color = settings.color_tolerance
    tolerances = (settings.texture_tolerance, settings.lightness_tolerance, color, color)
    cost = np.zeros(pixels.u.shape, np.float32)
    for there, own, contrast, tolerance in zip(
        target.appearance, source.appearance, source.contrast, tolerances, strict=True
    ):
        difference = there.take(cell) - own
        difference /= tolerance + np.float32(settings.contrast_tolerance) * contrast
        difference *= difference
        cost += difference
    cost *= half
    return np.asarray(np.minimum(cost, np.float32(settings.max_color)))
