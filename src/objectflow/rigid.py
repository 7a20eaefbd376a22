"""The rigid motion of one object: robust fit to matches, then refinement against the other frame's depth, colour."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from objectflow import geometry
from objectflow.correspondence import Matches, gray
from objectflow.frame import Camera, RgbdFrame
from objectflow.noise import depth_sigma, match_sigma
from objectflow.normals import surface_normals

Array = NDArray[np.float64]
Floats = NDArray[np.float32]

_TUKEY = 4.685
"""Tukey's biweight constant for 95% efficiency under Gaussian noise."""


def fit_matches(
    matches: Matches, camera: Camera, *, weights: Floats | None = None, iterations: int = 8
) -> tuple[Array, NDArray[np.bool_]]:
    """Trimmed weighted Kabsch: fit, drop what is further off than noise explains, fit again.

    Args:
        matches: at least three, from one object for the most part.
        camera: its focal length turns pixels of matching error into metres.
        weights: (N,) prior weights; ones when None.
        iterations: at most this many fits.

    Returns:
        (4, 4) `prev_T_curr`, and (N,) bool: the matches that it explains.
    """
    prior = np.ones(len(matches.curr)) if weights is None else weights.astype(np.float64)
    sigma = match_sigma(matches.curr[:, 2], camera).astype(np.float64)
    # Precise points count more, as maximum likelihood has it.
    precision = prior / sigma**2
    prev_T_curr = _rough_fit(matches, sigma, precision)
    for _ in range(iterations):
        error = np.linalg.norm(geometry.transform(prev_T_curr, matches.curr.astype(np.float64)) - matches.prev, axis=1)
        scaled = error / sigma
        scale = max(1.0, 1.4826 * float(np.median(scaled)))
        robust = np.where(scaled < _TUKEY * scale, (1 - (scaled / (_TUKEY * scale)) ** 2) ** 2, 0.0)
        if (robust > 0).sum() < 3:
            break
        updated, determined = geometry.kabsch(matches.curr, matches.prev, precision * robust)
        if not determined:
            break
        change = np.abs(updated - prev_T_curr).max()
        prev_T_curr = updated
        if change < 1e-7:
            break
    error = np.linalg.norm(geometry.transform(prev_T_curr, matches.curr.astype(np.float64)) - matches.prev, axis=1)
    return prev_T_curr, error < 3 * sigma


def _rough_fit(matches: Matches, sigma: Array, precision: Array, trials: int = 40) -> Array:
    """The best by truncated squares of the fit to all matches and the fits to triplets spread over them.

    The triplets step through the list at ever other strides, and need no random numbers.
    """
    count = len(matches.curr)
    trial = np.arange(trials)
    stride = 1 + (trial * 37) % max(1, count // 2)
    triplets = (trial[:, None] * count // trials + stride[:, None] * np.arange(3)) % count
    motions, determined = geometry.kabsch(matches.curr[triplets], matches.prev[triplets])
    everything, _ = geometry.kabsch(matches.curr, matches.prev, precision)
    motions = np.concatenate([everything[None], motions[determined]])
    misfit = np.minimum(squared_errors(motions, matches.curr, matches.prev) / sigma**2, 9).sum(axis=1)
    return np.asarray(motions[misfit.argmin()])


def squared_errors(motions: Array, curr: NDArray[np.floating[Any]], prev: NDArray[np.floating[Any]]) -> Array:
    """Squared distance of every point, carried by every motion, to its match.

    Args:
        motions: (K, 4, 4) `prev_T_curr`.
        curr, prev: (N, 3) metres.

    Returns:
        (K, N) square metres.
    """
    # Coordinates first: sums over the three of them are then sums of long rows.
    off = motions[:, :3, :3] @ curr.T.astype(np.float64) + (motions[:, :3, 3, None] - prev.T)
    off *= off
    return np.asarray(off[:, 0] + off[:, 1] + off[:, 2])


class Target:
    """The previous frame, made ready to be aligned with: points, normals, colour and its gradient.

    Attributes:
        camera: the frame's camera.
        points, normals: (H, W, 3) float32; NaN where there is no depth or no surface.
        images: grey images, coarse to fine; gradients: du and dv of each, per pixel.
    """

    def __init__(self, prev: RgbdFrame) -> None:
        self.camera = prev.camera
        self.points = geometry.back_project(prev.depth, prev.camera)
        self.normals = surface_normals(prev.depth, prev.camera)
        base = gray(prev.color).astype(np.float32)
        self.images: list[NDArray[Any]] = [cv2.GaussianBlur(base, (0, 0), sigma) for sigma in GRAY_BLURS]
        self.gradients: list[tuple[NDArray[Any], NDArray[Any]]] = [
            (cv2.Sobel(image, cv2.CV_32F, 1, 0, scale=1 / 8), cv2.Sobel(image, cv2.CV_32F, 0, 1, scale=1 / 8))
            for image in self.images
        ]


GRAY_BLURS = (3.0, 1.0)
"""Pixels of blur, coarse to fine: colour then pulls over several pixels first and is exact at the end."""


class Source(NamedTuple):
    """Points of one object in the current frame.

    Attributes:
        points: (N, 3) float32 metres.
        grays: one (N,) float32 for each of `GRAY_BLURS`.
    """

    points: Floats
    grays: tuple[Floats, ...]


@dataclass(frozen=True)
class Refined:
    """What `refine` returns.

    Attributes:
        prev_T_curr: (4, 4).
        explained: share of the points seen in `prev` that lie on its surface to within three sigma.
        visible: share of the points that `prev` sees (not hidden, not outside, depth there).
        depth_error: root mean square distance to the surface of the explained points, metres.
    """

    prev_T_curr: Array
    explained: float
    visible: float
    depth_error: float


def make_source(curr: RgbdFrame, mask: NDArray[np.bool_], *, limit: int = 4000) -> Source:
    """The points of a mask, thinned evenly to at most `limit`.

    Args:
        curr: the current frame.
        mask: (H, W) bool; pixels without depth are left out.
        limit: refinement needs no more points than this to be as exact as the sensor.
    """
    rows, columns = np.nonzero(mask & curr.valid)
    if len(rows) > limit:
        pick = np.linspace(0, len(rows) - 1, limit).astype(int)
        rows, columns = rows[pick], columns[pick]
    base = gray(curr.color).astype(np.float32)
    grays = tuple(cv2.GaussianBlur(base, (0, 0), sigma)[rows, columns].astype(np.float32) for sigma in GRAY_BLURS)
    return Source(geometry.back_project(curr.depth, curr.camera)[rows, columns], grays)


def refine(
    target: Target,
    source: Source,
    prev_T_curr: Array,
    *,
    matches: Matches | None = None,
    iterations: int = 12,
    color_weight: float = 0.5,
) -> Refined:
    """Projective point-to-plane ICP with a colour term, and matches as a third, by robust Gauss-Newton.

    Minimises over a twist `x`, applied on the left: `sum w (n.(p - q) / s)^2 + c sum w ((I_prev - I_curr) / g)^2 +
    sum w |p - m|^2 / d^2`, where p is a point carried to `prev`, q the surface point there, n its normal, m its match
    (Chen and Medioni 1992; the colour term as Steinbrucker et al. 2011).

    Args:
        target: the previous frame.
        source: the object's points in the current one.
        prev_T_curr: where to start; the basin is a few centimetres and a few pixels.
        matches: of this object, or None. They hold what a flat, dull surface leaves free.
        iterations: for each of the two blurs.
        color_weight: c; neighbouring pixels are alike, so one grey residual counts less than a depth one.
    """
    T = np.array(prev_T_curr, dtype=np.float64)
    if len(source.points) < 6:
        return Refined(T, 0.0, 0.0, float("inf"))
    for level in range(len(GRAY_BLURS)):
        for iteration in range(iterations):
            gate = max(0.03 * 0.7 ** (iteration + 4 * level), 0.008)
            H, b = _normal_equations(target, source, T, level, gate, color_weight)
            if matches is not None and len(matches.curr) >= 3:
                H_m, b_m = _match_equations(matches, T, target.camera)
                H, b = H + H_m, b + b_m
            # Levenberg's damping relative to each axis' own curvature; directions that nothing sees stay put.
            damping = 1e-4 * np.diag(H) + 1e-6 * np.trace(H) / 6 + 1e-9
            step = np.linalg.solve(H + np.diag(damping), -b)
            T = geometry.se3_exp(step) @ T
            if np.abs(step).max() < 3e-5:  # 0.03 mm: far below what a depth camera resolves
                break
    return judge(target, source, T)


def _normal_equations(
    target: Target, source: Source, T: Array, level: int, gate: float, color_weight: float
) -> tuple[Array, Array]:
    """The 6x6 system of the depth and the colour terms at T."""
    camera = target.camera
    points = geometry.transform(T, source.points)
    pixels, inside, index = _nearest_pixels(points, camera)
    points, pixels = points[inside], pixels[inside]
    surface, normal = target.points[index], target.normals[index]
    offset = points - surface
    sigma = depth_sigma(points[:, 2])
    with np.errstate(invalid="ignore"):
        # The gate opens with the sensor's noise; beyond it lies another surface, or the object is hidden there.
        usable = np.abs(offset[:, 2]) < gate + 3 * sigma
        along = (offset * normal).sum(-1)
        usable &= np.isfinite(along)
    p, n = points[usable].astype(np.float64), normal[usable].astype(np.float64)
    r = along[usable] / sigma[usable]
    weight = _tukey(r)
    J = np.concatenate([n, _cross(p, n)], axis=1) / sigma[usable, None]
    H, b = J.T @ (weight[:, None] * J), J.T @ (weight * r)
    if color_weight > 0 and usable.sum() > 6:
        g_u, g_v = (_sample(gradient, pixels[usable]) for gradient in target.gradients[level])
        difference = _sample(target.images[level], pixels[usable]) - source.grays[level][inside][usable]
        difference -= np.median(difference)  # exposure may have changed between the frames
        x, y, z = p.T
        toward = np.stack(
            [g_u * camera.fx / z, g_v * camera.fy / z, -(g_u * camera.fx * x + g_v * camera.fy * y) / z**2], axis=1
        )
        noise = max(4.0, 1.4826 * float(np.median(np.abs(difference))))
        r_c = difference / noise
        weight = color_weight * _tukey(r_c)
        J = np.concatenate([toward, _cross(p, toward)], axis=1) / noise
        H, b = H + J.T @ (weight[:, None] * J), b + J.T @ (weight * r_c)
    return H, b


def _nearest_pixels(
    points: Floats, camera: Camera
) -> tuple[Floats, NDArray[np.bool_], tuple[NDArray[np.intp], NDArray[np.intp]]]:
    """(N, 2) where points fall, (N,) which lie on the image, and the rows and columns of those that do."""
    pixels = geometry.project(points, camera)
    with np.errstate(invalid="ignore"):
        column, row = np.rint(pixels[:, 0]), np.rint(pixels[:, 1])
        inside = (column >= 0) & (row >= 0) & (column < camera.width) & (row < camera.height)
    return pixels, inside, (row[inside].astype(np.intp), column[inside].astype(np.intp))


def _match_equations(matches: Matches, T: Array, camera: Camera) -> tuple[Array, Array]:
    """The 6x6 system of the matches' own distances at T."""
    p = geometry.transform(T, matches.curr.astype(np.float64))
    sigma = match_sigma(matches.curr[:, 2], camera).astype(np.float64)
    r = (p - matches.prev) / sigma[:, None]
    weight = _tukey(np.linalg.norm(r, axis=1))
    J = np.concatenate([np.broadcast_to(np.eye(3), (len(p), 3, 3)), -geometry.hat(p)], axis=2) / sigma[:, None, None]
    J, weight = J.reshape(-1, 6), np.repeat(weight, 3)
    weighted = (weight[:, None] * J).T
    return weighted @ J, weighted @ r.ravel()


def judge(target: Target, source: Source, T: Array) -> Refined:
    """How well a motion explains the points that the previous frame sees; see `Refined`."""
    camera = target.camera
    points = geometry.transform(T, source.points)
    _, inside, index = _nearest_pixels(points, camera)
    offset = points[inside] - target.points[index]
    sigma = depth_sigma(points[inside, 2])
    seen = np.isfinite(offset[:, 2]) & (offset[:, 2] < 3 * sigma + 0.01)
    distance = np.abs((offset * target.normals[index]).sum(-1))
    distance = np.where(np.isfinite(distance), distance, np.abs(offset[:, 2]))
    good = seen & (distance < 3 * sigma)
    if not good.any():
        return Refined(T, 0.0, float(seen.sum()) / len(points), float("inf"))
    return Refined(
        prev_T_curr=T,
        explained=float(good.sum()) / float(seen.sum()),
        visible=float(seen.sum()) / len(points),
        depth_error=float(np.sqrt(np.mean(distance[good] ** 2))),
    )


def _cross(a: Array, b: Array) -> Array:
    """(N, 3) x (N, 3): np.cross in a third of the time, for a loop that lives on it."""
    (x, y, z), (u, v, w) = a.T, b.T
    return np.stack([y * w - z * v, z * u - x * w, x * v - y * u], axis=1)


def _tukey(r: NDArray[np.floating]) -> Array:
    scaled = np.asarray(r, dtype=np.float64) / _TUKEY
    return np.where(np.abs(scaled) < 1, (1 - scaled**2) ** 2, 0.0)


def _sample(image: NDArray[Any], pixels: Floats) -> Array:
    """Bilinear values at (N, 2) pixels."""
    out = cv2.remap(
        image, pixels[None, :, 0].astype(np.float32), pixels[None, :, 1].astype(np.float32), cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    )  # fmt: skip
    return np.asarray(out[0], dtype=np.float64)
