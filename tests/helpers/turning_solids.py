"""Analytic solids that turn before a camera, with noisy depth, exact masks and exact poses."""

from __future__ import annotations

import json
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from analytic import World, pixel_rays
from analytic_solids import Solid, draw_texture
from objectflow.frame import RgbdFrame
from objectflow.geometry.camera import Camera
from objectflow.typing import BoolMask, Float64Array

CAMERA = Camera(320, 240, 307.0, 307.0, 159.5, 119.5)


class View(NamedTuple):
    """One frame of a turning solid.

    Attributes:
        frame: with noisy depth; a plane lies behind the solid.
        mask: its exact pixels.
        camera_T_object: its pose.
        points: (N, 3) metres in the object frame: the exact surface at its pixels.
    """

    frame: RgbdFrame
    mask: BoolMask
    camera_T_object: Float64Array
    points: Float64Array


def solid(kind: str, size: tuple[float, float, float], seed: int = 0) -> Solid:
    """A textured solid; see `Solid`."""
    return Solid(kind, np.array(size), draw_texture(np.random.default_rng(seed), np.full(3, 48)))


def turning(
    shape: Solid,
    count: int,
    *,
    degrees: float = 12.0,
    distance: float = 1.0,
    noise: float = 0.0019,
    camera: Camera = CAMERA,
    seed: int = 0,
) -> list[View]:
    """Views of a solid that turns about the vertical and slides by 5 mm a frame.

    Args:
        shape: the solid.
        count: number of frames.
        degrees: rotation per frame.
        distance: of the solid from the camera, metres.
        noise: standard deviation of depth at 1 m, metres; it grows with the square of depth.
        camera: of all frames.
        seed: of the noise.
    """
    rng = np.random.default_rng(seed)
    plane = draw_texture(rng, np.array([128, 128]), plane=True)
    # The camera looks down at 35 degrees at a point 0.5 m above the plane.
    tilt = np.radians(35)
    z = np.array([0, np.cos(tilt), -np.sin(tilt)])
    world_T_camera = np.eye(4)
    world_T_camera[:3, :3] = np.stack([[1, 0, 0], np.cross(z, [1, 0, 0]), z], axis=1)
    world_T_camera[:3, 3] = np.array([0, 0, 0.5]) - distance * z
    views = []
    for k in range(count):
        world_T_object = np.eye(4)
        world_T_object[:3, :3] = Rotation.from_euler("zx", [degrees * k, 20], degrees=True).as_matrix()
        world_T_object[:3, 3] = [0.005 * (k - count / 2), 0, 0.5]
        world = World([shape], [world_T_object], world_T_camera, plane, np.array([0.3, -0.5, 0.81]))
        rays = pixel_rays(camera)
        exact, labels, _ = world.cast(rays)
        depth = exact + rng.standard_normal(len(exact)) * noise * exact**2
        size = (camera.height, camera.width)
        color = np.clip(np.rint(world.shade(rays)), 0, 255).astype(np.uint8).reshape(*size, 3)
        camera_T_object = np.linalg.inv(world_T_camera) @ world_T_object
        R, t = camera_T_object[:3, :3], camera_T_object[:3, 3]
        seen = labels > 0
        points = ((rays * exact[:, None])[seen] - t) @ R
        frame = RgbdFrame(color, depth.reshape(size).astype(np.float32), camera)
        views.append(View(frame, seen.reshape(size), camera_T_object, points))
    return views


def distance_to_surface(shape: Solid, points: Float64Array) -> Float64Array:
    """(N,) metres: unsigned distance of points (N, 3), object frame, to the surface of a box or a sphere."""
    if shape.kind == "sphere":
        return np.asarray(np.abs(np.linalg.norm(points, axis=1) - shape.size[0]))
    beyond = np.abs(points) - shape.size
    outside = np.linalg.norm(np.maximum(beyond, 0), axis=1)
    return np.asarray(np.where((beyond < 0).all(axis=1), -beyond.max(axis=1), outside))


def write_recording(folder: Path, views: list[View]) -> None:
    """Write views as a folder of numbered frames, with depth in tenths of a millimetre."""
    for name in ("color", "depth"):
        (folder / name).mkdir(parents=True)
    for index, view in enumerate(views):
        cv2.imwrite(str(folder / "color" / f"{index:04d}.png"), cv2.cvtColor(view.frame.color, cv2.COLOR_RGB2BGR))
        depth = np.rint(10_000 * view.frame.depth).astype(np.uint16)
        cv2.imwrite(str(folder / "depth" / f"{index:04d}.png"), depth)
    camera = {**views[0].frame.camera.to_dict(), "depth_scale": 10_000}
    (folder / "camera.json").write_text(json.dumps(camera))
