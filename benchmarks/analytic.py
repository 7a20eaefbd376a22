"""Analytic scenes: textured boxes, spheres and cylinders on a plane, ray-cast with known motion.

Uses only the frame classes of the package, so flow, visibility and motions are an independent reference. World frame:
z up, plane at z = 0. Rays are `t * (x, y, 1)` in a camera frame, so `t` is the planar depth.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
from scipy.spatial.transform import Rotation

from analytic_solids import Solid, Texture, draw_texture, unit
from objectflow.frame import RgbdFrame
from objectflow.geometry.camera import Camera
from objectflow.typing import BoolMask, Float32Array, Float64Array, LabelImage

Rng = np.random.Generator


@dataclass(frozen=True, eq=False)
class AnalyticPair:
    """Two frames of one scene with their ground truth.

    Attributes:
        prev, curr: the frames.
        labels, prev_labels: (H, W) int32 labels of curr and prev; 0 = plane, k = k-th object.
        prev_T_curr: label -> (4, 4), camera frame of curr to camera frame of prev, also for static objects.
        scene_flow: (H, W, 3) float32, exact `P_prev - P_curr` on curr's pixels, from noise-free depth.
        visible: (H, W) bool: whether curr's point is visible in prev.
        moving: labels of the objects that moved in the world.
        centers: label -> (3,) centre in curr's camera frame, metres.
        camera_motion: (4, 4) `prev_T_curr` of the static world; identity for a static camera.
        kinds: label -> "box", "sphere" or "cylinder".
    """

    prev: RgbdFrame
    curr: RgbdFrame
    labels: LabelImage
    prev_labels: LabelImage
    prev_T_curr: dict[int, Float64Array]
    scene_flow: Float32Array
    visible: BoolMask
    moving: frozenset[int]
    centers: dict[int, Float64Array]
    camera_motion: Float64Array
    kinds: dict[int, str] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class World:
    """Solids with their poses at one time, the plane, the light and the camera."""

    solids: list[Solid]
    world_T_object: list[Float64Array]
    world_T_camera: Float64Array
    plane: Texture
    light: Float64Array  # (3,) unit, world frame, towards the light

    def cast(self, rays: Float64Array) -> tuple[Float64Array, LabelImage, Float64Array]:
        """Camera rays (N, 3) with z = 1 -> planar depth (N,) (inf: no hit), labels, normals in the world frame."""
        world_R, eye = self.world_T_camera[:3, :3], self.world_T_camera[:3, 3]
        vertical = rays @ world_R[2]
        with np.errstate(divide="ignore"):
            depth = np.where(vertical < 0, -eye[2] / vertical, np.inf)
        labels = np.zeros(len(rays), dtype=np.int32)
        normals = np.tile(np.array([0.0, 0, 1]), (len(rays), 1))
        length2 = (rays**2).sum(1)
        for label, (solid, world_T_object) in enumerate(zip(self.solids, self.world_T_object, strict=True), start=1):
            object_T_camera = np.linalg.inv(world_T_object) @ self.world_T_camera
            center = np.linalg.inv(object_T_camera)[:3, 3]
            # Only rays that hit the bounding sphere are tested.
            near = np.flatnonzero(center @ center - (rays @ center) ** 2 / length2 < solid.radius**2)
            t, normal = solid.hit(object_T_camera[:3, 3], rays[near] @ object_T_camera[:3, :3].T)
            nearest = t < depth[near]
            hit = near[nearest]
            depth[hit], labels[hit] = t[nearest], label
            normals[hit] = normal[nearest] @ world_T_object[:3, :3].T
        return depth, labels, normals

    def shade(self, rays: Float64Array) -> Float64Array:
        """Colours (N, 3) in 0..255 of camera rays: Lambertian with ambient light, without shadows."""
        depth, labels, normals = self.cast(rays)
        rgb = np.full((len(rays), 3), 90.0)
        hit = np.isfinite(depth)
        points = (rays * np.where(hit, depth, 0)[:, None]) @ self.world_T_camera[:3, :3].T + self.world_T_camera[:3, 3]
        for label in np.unique(labels[hit]):
            index = np.flatnonzero(hit & (labels == label))
            if label == 0:
                rgb[index] = self.plane.at(points[index])
                # Distant pixels cover many texels, so their colour fades to the mean to avoid aliasing.
                fade = np.clip((depth[index] - 1.0) / 1.5, 0, 1)[:, None]
                rgb[index] = rgb[index] * (1 - fade) + self.plane.colors[:2].mean(0) * fade
            else:
                R, t = self.world_T_object[label - 1][:3, :3], self.world_T_object[label - 1][:3, 3]
                rgb[index] = self.solids[label - 1].texture.at((points[index] - t) @ R)
        return np.asarray(rgb * (0.4 + 0.65 * np.clip(normals @ self.light, 0, 1))[:, None])


def pixel_rays(camera: Camera, du: float = 0.0, dv: float = 0.0) -> Float64Array:
    """(H * W, 3) rays with z = 1 through the pixel centres shifted by (du, dv) pixels."""
    u, v = np.meshgrid(np.arange(camera.width) + du, np.arange(camera.height) + dv)
    x, y = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy
    return np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3)


def make_scene(
    seed: int,
    *,
    objects: tuple[int, int] = (1, 6),
    width: int = 320,
    height: int = 240,
    motion: tuple[float, float] = (0.02, 0.06),
    max_angle_deg: float = 30.0,
    moving_share: float = 1.0,
    depth_noise: float = 0.0,
    camera_motion: Float64Array | None = None,
) -> AnalyticPair:
    """Generate and render a scene of a few objects that slide, rotate or are lifted between two frames.

    Args:
        seed: determines the scene, which is the same at every resolution.
        objects: minimum and maximum number of objects.
        width, height: pixels; the focal length scales with the width.
        motion: minimum and maximum displacement of a moving object's centre, metres.
        max_angle_deg: maximum rotation of a moving object.
        moving_share: share of the objects that move (rounded; at least one object unless 0).
        depth_noise: standard deviation of depth at 1 m in metres; grows with the square of depth.
        camera_motion: (4, 4) `prev_T_curr` of the static world for a moving camera; None for a static camera.
    """
    key = None if camera_motion is None else np.asarray(camera_motion, np.float64).tobytes()
    # The same scene is requested by many tests; each receives a copy of its own.
    return copy.deepcopy(
        _make_scene(seed, objects, width, height, motion, max_angle_deg, moving_share, depth_noise, key)
    )


@lru_cache(maxsize=64)
def _make_scene(
    seed: int,
    objects: tuple[int, int],
    width: int,
    height: int,
    motion: tuple[float, float],
    max_angle_deg: float,
    moving_share: float,
    depth_noise: float,
    camera_motion: bytes | None,
) -> AnalyticPair:
    rng = np.random.default_rng(seed)
    static_camera = camera_motion is None
    world_motion: Float64Array = (
        np.eye(4) if camera_motion is None else np.frombuffer(camera_motion, np.float64).reshape(4, 4)
    )
    curr_T_prev_camera: Float64Array = np.asarray(np.linalg.inv(world_motion), dtype=np.float64)
    focal = 236.46 / 320 * width
    camera = Camera(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)
    plane = draw_texture(rng, np.array([512, 512]), plane=True)
    light = unit(np.array([rng.uniform(-0.6, 0.6), rng.uniform(-0.6, 0.6), 1.0]))
    count = int(rng.integers(objects[0], objects[1] + 1))
    prev, curr, moved = _draw_layout(
        rng,
        count,
        motion,
        max_angle_deg,
        moving_share,
        curr_T_prev_camera=curr_T_prev_camera,
        plane=plane,
        light=light,
    )

    curr_frame, labels, depth = _render(curr, camera, rng, depth_noise, "analytic curr")
    prev_frame, prev_labels, _ = _render(prev, camera, rng, depth_noise, "analytic prev")

    prev_T_curr: dict[int, Float64Array] = {}
    centers: dict[int, Float64Array] = {}
    camera_prev_T_world, camera_curr_T_world = np.linalg.inv(prev.world_T_camera), np.linalg.inv(curr.world_T_camera)
    for label, (a, b) in enumerate(zip(prev.world_T_object, curr.world_T_object, strict=True), start=1):
        object_motion = camera_prev_T_world @ a @ np.linalg.inv(b) @ curr.world_T_camera
        prev_T_curr[label] = object_motion if label in moved else world_motion
        centers[label] = (camera_curr_T_world @ b)[:3, 3]

    rays = pixel_rays(camera)
    hit = np.isfinite(depth)
    points = rays * np.where(hit, depth, np.nan)[:, None]
    flow = np.zeros_like(points)
    for label in range(count + 1):
        a_T_b = prev_T_curr[label] if label else world_motion
        if label in moved or not static_camera:
            mask = labels == label
            flow[mask] = points[mask] @ (a_T_b[:3, :3] - np.eye(3)).T + a_T_b[:3, 3]
    flow[~hit] = np.nan
    shape = (height, width)
    return AnalyticPair(
        prev=prev_frame,
        curr=curr_frame,
        labels=labels.reshape(shape),
        prev_labels=prev_labels.reshape(shape),
        prev_T_curr=prev_T_curr,
        scene_flow=flow.reshape(*shape, 3).astype(np.float32),
        visible=_visible(prev, camera, points + flow).reshape(shape),
        moving=moved,
        centers=centers,
        camera_motion=world_motion,
        kinds={label: solid.kind for label, solid in enumerate(curr.solids, start=1)},
    )


def _render(
    world: World, camera: Camera, rng: Rng, depth_noise: float, name: str
) -> tuple[RgbdFrame, LabelImage, Float64Array]:
    """The frame, and labels and exact depth (H * W,) at its pixel centres."""
    depth, labels, _ = world.cast(pixel_rays(camera))
    samples = [world.shade(pixel_rays(camera, du, dv)) for du in (-0.25, 0.25) for dv in (-0.25, 0.25)]
    color = np.clip(np.rint(sum(samples[1:], samples[0]) / 4), 0, 255).astype(np.uint8)
    z = np.where(np.isfinite(depth), depth, 0)
    noise = rng.standard_normal(len(depth)) * depth_noise
    measured = np.where(z > 0, np.maximum(z + noise * z**2, 1e-3), 0)
    shape = (camera.height, camera.width)
    frame = RgbdFrame(color.reshape(*shape, 3), measured.reshape(shape).astype(np.float32), camera, name=name)
    return frame, labels, depth


def _visible(world: World, camera: Camera, points: Float64Array) -> BoolMask:
    """Whether points (N, 3) of the camera frame lie in the image and are not occluded, by ray casting."""
    z = points[:, 2]
    ok = np.isfinite(z) & (np.nan_to_num(z) > 0)
    rays = points[ok] / z[ok, None]
    u, v = rays[:, 0] * camera.fx + camera.cx, rays[:, 1] * camera.fy + camera.cy
    inside = (u >= -0.5) & (u < camera.width - 0.5) & (v >= -0.5) & (v < camera.height - 0.5)
    depth, _, _ = world.cast(rays)
    out = np.zeros(len(points), dtype=bool)
    out[ok] = inside & (depth > z[ok] - 1e-4)
    return out


def _draw_layout(
    rng: Rng,
    count: int,
    motion: tuple[float, float],
    max_angle_deg: float,
    moving_share: float,
    *,
    curr_T_prev_camera: Float64Array,
    plane: Texture,
    light: Float64Array,
) -> tuple[World, World, frozenset[int]]:
    """The scene at both times, sampled until all objects are visible enough and apart from each other in both."""
    mover_count = min(count, max(1, round(moving_share * count))) if moving_share > 0 else 0
    coarse = Camera(80, 60, 236.46 / 4, 236.46 / 4, 39.5, 29.5)
    while True:
        solids = [_draw_solid(rng) for _ in range(count)]
        moved = frozenset(int(k) + 1 for k in rng.permutation(count)[:mover_count])
        world_T_curr_camera = _draw_camera(rng)
        placed: list[tuple[Float64Array, Float64Array]] = []
        for label, solid in enumerate(solids, start=1):
            for _ in range(200):
                a = _draw_rest(rng, solid)
                b = _move(rng, solid, a, motion, max_angle_deg) if label in moved else a
                if all(
                    _apart(solid, a, other, c) and _apart(solid, b, other, d)
                    for other, (c, d) in zip(solids, placed, strict=False)
                ):
                    placed.append((a, b))
                    break
            else:
                break
        if len(placed) < count:
            continue
        prev = World(solids, [p[0] for p in placed], world_T_curr_camera @ curr_T_prev_camera, plane, light)
        curr = World(solids, [p[1] for p in placed], world_T_curr_camera, plane, light)
        # 15 pixels of the coarse image correspond to 240 pixels at 320x240.
        pixels = [np.bincount(w.cast(pixel_rays(coarse))[1], minlength=count + 1) for w in (prev, curr)]
        if min(p[1:].min() for p in pixels) >= 15:
            return prev, curr, moved


def _draw_camera(rng: Rng) -> Float64Array:
    """world_T_camera of a camera that looks down at the table's centre from a distance of 0.5-0.9 m."""
    elevation, azimuth = np.radians(rng.uniform(35, 65)), rng.uniform(0, 2 * np.pi)
    target = np.array([rng.uniform(-0.03, 0.03), rng.uniform(-0.03, 0.03), 0.03])
    back = np.array([np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)])
    z = -back
    x = unit(np.cross(z, [0, 0, 1]))
    out = np.eye(4)
    out[:3, :3] = np.stack([x, np.cross(z, x), z], axis=1)
    out[:3, 3] = target + rng.uniform(0.5, 0.9) * back
    return out


def _draw_solid(rng: Rng) -> Solid:
    kind = str(rng.choice(["box", "box", "sphere", "cylinder"]))
    if kind == "box":
        size = rng.uniform(0.03, 0.08, 3)
    elif kind == "sphere":
        size = np.full(3, rng.uniform(0.035, 0.06))
    else:
        radius = rng.uniform(0.03, 0.05)
        size = np.array([radius, radius, rng.uniform(0.04, 0.09)])
    return Solid(kind, size, draw_texture(rng, np.full(3, 48)))


def _draw_rest(rng: Rng, solid: Solid) -> Float64Array:
    """A pose on the plane: a box on a face, a sphere in any orientation, a cylinder upright or lying."""
    R = Rotation.from_euler("z", rng.uniform(0, 2 * np.pi)).as_matrix()
    if solid.kind == "sphere":
        R = Rotation.from_quat(rng.standard_normal(4)).as_matrix()
    elif solid.kind == "cylinder" and rng.random() < 0.4:
        R = R @ Rotation.from_euler("x", np.pi / 2).as_matrix()
    out = np.eye(4)
    out[:3, :3] = R
    out[:2, 3] = rng.uniform(-0.2, 0.2, 2)
    out[2, 3] = _reach(solid, R, np.array([[0.0, 0, -1]]))[0]
    return out


def _move(
    rng: Rng, solid: Solid, pose: Float64Array, motion: tuple[float, float], max_angle_deg: float
) -> Float64Array:
    """The pose after a slide with a rotation about the vertical; one in four is lifted and rotated about any axis."""
    lifted = rng.random() < 0.25
    any_axis = lifted or solid.kind == "sphere"
    axis = unit(rng.standard_normal(3)) if any_axis else np.array([0.0, 0, 1])
    rotation = Rotation.from_rotvec(axis * np.radians(rng.uniform(-max_angle_deg, max_angle_deg))).as_matrix()
    heading, distance = rng.uniform(0, 2 * np.pi), rng.uniform(*motion)
    step = distance * np.array([np.cos(heading), np.sin(heading), 0])
    out = pose.copy()
    out[:3, :3] = rotation @ pose[:3, :3]
    if lifted:
        # A tilted solid is raised enough to clear the plane, and moves sideways by the remaining distance.
        clearance = _reach(solid, out[:3, :3], np.array([[0.0, 0, -1]]))[0] - pose[2, 3]
        rise = min(distance, max(clearance, 0) + 0.5 * distance * rng.random())
        if rise < clearance:
            out[:3, :3] = pose[:3, :3]
        step = np.sqrt(max(distance**2 - rise**2, 0)) * step / distance + np.array([0, 0, rise])
    out[:3, 3] = pose[:3, 3] + step
    return out


def _reach(solid: Solid, rotation: Float64Array, directions: Float64Array) -> Float64Array:
    return solid.support(directions @ rotation)


_DIRECTIONS = np.stack([np.cos(np.arange(72) * np.pi / 36), np.sin(np.arange(72) * np.pi / 36), np.zeros(72)], axis=1)


def _apart(a: Solid, world_T_a: Float64Array, b: Solid, world_T_b: Float64Array, gap: float = 0.004) -> bool:
    """Whether a vertical plane separates two solids by more than `gap` metres (72 directions are tested)."""
    distance = _DIRECTIONS @ (world_T_b[:3, 3] - world_T_a[:3, 3])
    reach = _reach(a, world_T_a[:3, :3], _DIRECTIONS) + _reach(b, world_T_b[:3, :3], -_DIRECTIONS)
    return bool((distance - reach).max() > gap)
