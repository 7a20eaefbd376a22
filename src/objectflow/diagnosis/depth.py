"""What a frame's depth and camera say about themselves: units, holes, steps, ray length, field of view."""

from __future__ import annotations

import numpy as np

from objectflow import geometry
from objectflow.diagnosis.finding import Finding
from objectflow.frame import RgbdFrame
from objectflow.geometry.camera import Camera
from objectflow.typing import Float64Array

NEAR, FAR = 0.15, 6.0
"""Metres: depth cameras over a table or in a room see their median within these."""
HOLES = 0.35
"""Share of pixels without depth from which on masks and motions suffer."""
STEPS = 100
"""Fewer different depths than this in a frame: 8-bit depth, or depth that went through a lossy picture format."""


def check_range(frame: RgbdFrame, name: str) -> Finding:
    """Whether depth is in metres, as far as its median tells."""
    median = float(np.median(frame.depth[frame.valid]))
    text = f"{name}: half of the pixels are nearer than {median:.3g} m"
    if median < NEAR:
        return Finding("depth units", "suspicious", f"{text}: is the depth scale too large?")
    if median > FAR:
        return Finding("depth units", "suspicious", f"{text}: is the depth scale too small (5000 for TUM recordings)?")
    return Finding("depth units", "fine", text)


def check_holes(frame: RgbdFrame, name: str) -> Finding:
    """How much depth is missing."""
    share = 1 - float(frame.valid.mean())
    text = f"{name}: {share:.0%} of the pixels have no depth"
    if share > HOLES:
        return Finding("holes", "suspicious", f"{text}: move the camera to its working range, away from shiny things")
    return Finding("holes", "fine", text)


def check_steps(frame: RgbdFrame, name: str) -> Finding:
    """How finely depth is resolved."""
    count = len(np.unique(frame.depth[frame.valid]))
    text = f"{name}: {count} different depths"
    if count < STEPS and np.ptp(frame.depth[frame.valid]) > 0.05:
        return Finding(
            "depth steps", "suspicious", f"{text}: store depth as a 16-bit PNG, not as a picture to look at"
        )
    return Finding("depth steps", "fine", text)


def check_field_of_view(camera: Camera) -> Finding:
    """Whether the focal length is one of a depth camera, and the principal point near the middle."""
    angle = float(np.degrees(2 * np.arctan(0.5 * camera.width / camera.fx)))
    off = max(
        abs(camera.cx - (camera.width - 1) / 2) / camera.width,
        abs(camera.cy - (camera.height - 1) / 2) / camera.height,
    )
    text = f"{angle:.0f} degrees wide, principal point {off:.0%} of the image off its middle"
    if not 35 <= angle <= 110 or off > 0.1:
        return Finding("camera", "suspicious", f"{text}: are the intrinsics of this camera, and of this resolution?")
    if abs(camera.fx / camera.fy - 1) > 0.05:
        return Finding(
            "camera", "suspicious", f"{text}, but fx / fy = {camera.fx / camera.fy:.2f}: has the image been squeezed?"
        )
    return Finding("camera", "fine", text)


def check_planar(frame: RgbdFrame, name: str, rng: np.random.Generator) -> Finding:
    """Whether depth is planar z: read as ray length, a flat table would bulge, and the other way round.

    The largest plane is sought under both readings; the right one makes it flatter.
    """
    points = geometry.back_project(frame.depth, frame.camera)[frame.valid].astype(np.float64)
    points = points[rng.permutation(len(points))[:4000]]
    rays = points / points[:, 2:]
    if len(points) < 200:
        return Finding("ray length", "note", f"{name}: too little depth to see a plane")
    as_z, share = _plane_error(points, rng)
    if share < 0.25:
        return Finding("ray length", "note", f"{name}: no plane large enough to tell planar z from ray length")
    # If the numbers were lengths along rays, the points would lie so much nearer.
    as_length, length_share = _plane_error(points / np.linalg.norm(rays, axis=1, keepdims=True), rng)
    flatness = f"{1000 * as_z:.1f} mm as planar z, {1000 * as_length:.1f} mm as ray length"
    text = f"{name}: the largest plane is flat to {flatness}"
    if length_share > 0.25 and as_length < 0.6 * as_z and as_z - as_length > 0.0005 and length_share > 0.9 * share:
        return Finding("ray length", "suspicious", f"{text}: convert ray length to planar z")
    return Finding("ray length", "fine", text)


def _plane_error(points: Float64Array, rng: np.random.Generator) -> tuple[float, float]:
    """Median distance of the largest plane's points from it, and the plane's share of all points."""
    triplets = points[rng.integers(0, len(points), (200, 3))]
    normals = np.cross(triplets[:, 1] - triplets[:, 0], triplets[:, 2] - triplets[:, 0])
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = normals / np.maximum(length, 1e-12)
    offsets = (normals * triplets[:, 0]).sum(1)
    # Wide enough for a plane that bulges: what counts is how flat it is, once found.
    width = 0.03 * float(np.median(points[:, 2]))
    inside = np.abs(normals @ points.T - offsets[:, None]) < width
    chosen = inside[(inside.sum(1) * (length[:, 0] > 1e-9)).argmax()]
    for _ in range(3):
        center = points[chosen].mean(0)
        normal = np.linalg.svd(points[chosen] - center, full_matrices=False)[2][2]
        distance = np.abs((points - center) @ normal)
        chosen = distance < width
    return float(np.median(distance[chosen])), float(chosen.mean())
