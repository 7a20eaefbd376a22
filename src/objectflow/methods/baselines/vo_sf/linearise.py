"""The brightness and depth constraints of a pixel, linearised in a twist."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from objectflow.methods.baselines.vo_sf.pyramid import Level, make_level
from objectflow.typing import BoolMask, Float32Array

PHOTOMETRIC_WEIGHT = np.float32(0.15)
"""Weight of brightness (0..1) relative to depth in metres."""
_STEP_FLOOR = {"gray": np.float32(1e-6), "depth": np.float32(0.005)}
"""Added to the differences that weight the two sides of a derivative."""


@dataclass(frozen=True, eq=False)
class Gradients:
    """Derivatives of gray and depth along u and v (per pixel) and in time.

    Attributes:
        gray, depth: each (3, H, W) float32: along u, along v, second frame minus first.
        middle: mean of the two frames, at which the derivatives are taken.
        usable: (H, W) bool: both frames have depth, and the pixel is not on the image border.
    """

    gray: Float32Array
    depth: Float32Array
    middle: Level
    usable: BoolMask


def gradients(first: Level, warped: Level) -> Gradients:
    """Compute the derivatives between the first frame and the warped second frame.

    A spatial derivative is the mean of the differences to both sides, each weighted by the size of the other, so that
    pixels beside an edge take the slope of their own side.
    """
    both = (first.depth > 0) & (warped.depth > 0)
    depth = np.where(both, (first.depth + warped.depth) / 2, 0).astype(np.float32)
    middle = make_level((first.gray + warped.gray) / np.float32(2), depth, first.camera)
    usable = both.copy()
    usable[[0, -1]] = usable[:, [0, -1]] = False
    return Gradients(
        gray=np.stack([*_slopes(middle.gray, both, "gray"), warped.gray - first.gray]),
        depth=np.stack([*_slopes(depth, both, "depth"), warped.depth - first.depth]),
        middle=middle,
        usable=usable,
    )


def constraints(
    level: Gradients, gray_weight: Float32Array, depth_weight: Float32Array
) -> tuple[Float32Array, Float32Array]:
    """Rows J and values r of every pixel of the system `J twist = r` for the motion from second to first frame.

    A displacement d = v + w x P changes brightness by -grad I . (the pixel's displacement), and depth by d_z minus
    the corresponding product with grad Z. Both have the form a . d, hence J = [a, P x a].

    Args:
        level: the derivatives.
        gray_weight, depth_weight: (H, W) weights of the two rows, brightness without PHOTOMETRIC_WEIGHT.

    Returns:
        J (H, W, 2, 6) and r (H, W, 2) float32, brightness first; the twist is [translation, rotation].
    """
    X, Y, Z = np.moveaxis(level.middle.points, -1, 0)
    camera = level.middle.camera
    inverse = 1 / np.where(Z > 0, Z, 1)
    J = np.empty((*Z.shape, 2, 6), np.float32)
    r = np.empty((*Z.shape, 2), np.float32)
    for row, (slope, weight) in enumerate(
        ((level.gray, gray_weight * PHOTOMETRIC_WEIGHT), (level.depth, depth_weight))
    ):
        gx = np.float32(camera.fx) * inverse * slope[0]
        gy = np.float32(camera.fy) * inverse * slope[1]
        ax, ay, az = -gx, -gy, (gx * X + gy * Y) * inverse + np.float32(row)
        for k, value in enumerate((ax, ay, az, Y * az - Z * ay, Z * ax - X * az, X * ay - Y * ax)):
            J[..., row, k] = weight * value
        r[..., row] = -weight * slope[2]
    return J, r


def uncertainty_weights(level: Gradients, confidence: Float32Array) -> tuple[Float32Array, Float32Array]:
    """(H, W) weights of brightness and depth, low where derivatives are large and the linearisation is inaccurate.

    Args:
        level: the derivatives.
        confidence: (H, W) factor of both weights, less than 1 where a static cluster may be moving.
    """
    out = []
    for slope, noise, gain in ((level.gray, 1.0, 10.0), (level.depth, 0.01, 200.0)):
        weight = np.sqrt(confidence / (np.float32(noise) + np.float32(gain) * (slope**2).sum(0)))
        weight = np.where(level.usable, weight, np.float32(0))
        out.append(weight / max(float(weight.max()), 1e-12))
    return out[0].astype(np.float32), out[1].astype(np.float32)


def _slopes(image: Float32Array, both: BoolMask, kind: str) -> tuple[Float32Array, Float32Array]:
    return _slope_along_rows(image, both, kind), _slope_along_rows(image.T, both.T, kind).T


def _slope_along_rows(image: Float32Array, both: BoolMask, kind: str) -> Float32Array:
    step = np.diff(image, axis=1)
    # The size of the difference to the right of a pixel without depth is set to 1.
    size = np.where(both[:, :-1], np.abs(step) + _STEP_FLOOR[kind], np.float32(1))
    left, right = size[:, :-1], size[:, 1:]
    slope = np.empty_like(image)
    slope[:, 1:-1] = (left * step[:, 1:] + right * step[:, :-1]) / (left + right)
    slope[:, 0], slope[:, -1] = slope[:, 1], slope[:, -2]
    return slope
