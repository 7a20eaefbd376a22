"""Render the packaged pair of frames: six objects on a table, three of which moved.

    python scripts/render_demo.py                  # writes src/objectflow/demo/pair

Ray casting in NumPy, independent of the package and its generator. World frame: metres, z up, table at z = 0. Rays are
`t * (x, y, 1)` in the camera frame, so `t` is the planar depth. Colours are linear until the final conversion.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial.transform import Rotation

from demo_paint import PAINT, wood

Array = NDArray[Any]

WIDTH, HEIGHT, FOCAL = 640, 480, 615.0
SAMPLES = 4
"""Colour samples per pixel and axis; depth and labels are sampled at the pixel centre."""
DEPTH_SCALE = 1000
SEED = 7
EYE, TARGET = np.array([0.03, -0.54, 0.45]), np.array([0.02, 0.035, 0.035])
LAMP, LAMP_RADIUS = np.array([-0.55, -0.35, 1.15]), 0.09


@dataclass(frozen=True)
class DemoObject:
    """An object and its placement.

    Attributes:
        name: also selects the paint.
        kind: "box", "can" (upright) or "ball".
        size: half extents of a box, (radius, radius, half height) of a can, (radius, ...) of a ball, metres.
        xy: position on the table in the current frame, metres.
        yaw_deg: rotation about the vertical in the current frame.
        displacement: on the table, previous to current frame, metres.
        rotation_deg: change of yaw, previous to current frame.
        rolls: whether a ball rolls along its displacement.
    """

    name: str
    kind: str
    size: tuple[float, float, float]
    xy: tuple[float, float]
    yaw_deg: float
    displacement: tuple[float, float] = (0.0, 0.0)
    rotation_deg: float = 0.0
    rolls: bool = False

    def pose(self, *, current: bool) -> Array:
        """world_T_object in one of the two frames."""
        xy = np.array(self.xy) - (0 if current else np.array(self.displacement))
        yaw = self.yaw_deg - (0 if current else self.rotation_deg)
        out = np.eye(4)
        out[:3, :3] = Rotation.from_euler("z", yaw, degrees=True).as_matrix()
        if self.rolls and not current:
            axis = np.cross([0, 0, 1], np.array([*self.displacement, 0.0])) / self.size[0]
            out[:3, :3] = Rotation.from_rotvec(-axis).as_matrix() @ out[:3, :3]
        out[:3, 3] = [*xy, self.size[2]]
        return out


OBJECTS = (
    DemoObject("cereal box", "box", (0.060, 0.022, 0.085), (-0.150, 0.160), 14),
    DemoObject("tea box", "box", (0.048, 0.034, 0.034), (0.010, -0.030), 28, (0.045, -0.020), 22),
    DemoObject("can", "can", (0.033, 0.033, 0.050), (0.165, 0.120), 40, (0.030, 0.030), -18),
    DemoObject("ball", "ball", (0.042, 0.042, 0.042), (-0.150, -0.060), 35, (0.019, 0.011), rolls=True),
    DemoObject("book", "box", (0.062, 0.085, 0.011), (0.235, -0.075), -12),
    DemoObject("jar", "can", (0.038, 0.038, 0.030), (0.020, 0.205), 0),
)


def cast(origin: Array, rays: Array, poses: list[Array]) -> tuple[Array, Array]:
    """Cast world rays (N, 3) from origins (N, 3) or (3,) to their nearest hits.

    Returns:
        (N,) distances in ray lengths, inf for no hit, and (N,) labels: object index from 1, 0 = table, -1 = no hit.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        t = np.broadcast_to(origin, rays.shape)[:, 2] / -rays[:, 2]
    label = np.where(t > 1e-6, 0, -1)
    nearest = np.where(t > 1e-6, t, np.inf)
    for index, (obj, world_T_object) in enumerate(zip(OBJECTS, poses, strict=True), start=1):
        R, center = world_T_object[:3, :3], world_T_object[:3, 3]
        o, d = (np.broadcast_to(origin, rays.shape) - center) @ R, rays @ R
        # The bounding sphere is tested first, since most rays miss an object.
        radius = float(np.linalg.norm(obj.size))
        closest = o - d * ((o * d).sum(-1) / (d * d).sum(-1))[:, None]
        near = np.nonzero((closest**2).sum(-1) < radius**2)[0]
        hit = INTERSECT[obj.kind](o[near], d[near], np.array(obj.size))
        better = (hit > 1e-6) & (hit < nearest[near])
        nearest[near[better]] = hit[better]
        label[near[better]] = index
    return nearest, label


def _slabs(o: Array, d: Array, size: Array) -> tuple[Array, Array]:
    with np.errstate(divide="ignore", invalid="ignore"):
        a, b = (-size - o) / d, (size - o) / d
    return np.minimum(a, b).max(-1), np.maximum(a, b).min(-1)


def _hit_box(o: Array, d: Array, size: Array) -> Array:
    enter, leave = _slabs(o, d, size)
    return np.where(enter < leave, enter, np.inf)


def _hit_ball(o: Array, d: Array, size: Array) -> Array:
    return _round(o, d, size[0])[0]


def _hit_can(o: Array, d: Array, size: Array) -> Array:
    enter, leave = _round(o[:, :2], d[:, :2], size[0])
    low, high = _slabs(o[:, 2:], d[:, 2:], size[2:])
    enter, leave = np.maximum(enter, low), np.minimum(leave, high)
    return np.where(enter < leave, enter, np.inf)


def _round(o: Array, d: Array, radius: float) -> tuple[Array, Array]:
    a, b, c = (d * d).sum(-1), (o * d).sum(-1), (o * o).sum(-1) - radius**2
    root = np.sqrt(np.maximum(b * b - a * c, 0))
    missed = b * b < a * c
    return np.where(missed, np.inf, (-b - root) / a), np.where(missed, -np.inf, (-b + root) / a)


INTERSECT = {"box": _hit_box, "can": _hit_can, "ball": _hit_ball}


def normals(obj: DemoObject, points: Array) -> Array:
    """Outward normals at surface points, both in the object frame."""
    if obj.kind == "ball":
        return points / obj.size[0]
    relative = points / np.array(obj.size)
    out = np.zeros_like(points)
    if obj.kind == "box":
        axis = np.abs(relative).argmax(-1)
        out[np.arange(len(out)), axis] = np.sign(relative[np.arange(len(out)), axis])
        return out
    lid = np.abs(relative[:, 2]) > 0.9995
    out[lid, 2] = np.sign(relative[lid, 2])
    out[~lid, :2] = points[~lid, :2] / obj.size[0]
    return out


def render(world_T_camera: Array, poses: list[Array], rng: np.random.Generator) -> tuple[Array, Array, Array]:
    """Render colour (H, W, 3) uint8 RGB, planar depth (H, W) metres and labels (H, W) int32."""
    depth, label = cast(EYE, pixel_rays(0.0, 0.0) @ world_T_camera[:3, :3].T, poses)
    light = np.zeros((HEIGHT * WIDTH, 3))
    for i in range(SAMPLES):
        for j in range(SAMPLES):
            du, dv = (np.array([i, j]) + rng.uniform(size=2)) / SAMPLES - 0.5
            light += shade(pixel_rays(du, dv) @ world_T_camera[:3, :3].T, poses, rng)
    light /= SAMPLES**2
    light = light / (1 + 0.12 * light)  # Compress highlights.
    color = np.clip(light, 0, 1) ** (1 / 2.2) * 255 + rng.normal(0, 1.2, light.shape)
    image = np.clip(np.rint(color), 0, 255).astype(np.uint8).reshape(HEIGHT, WIDTH, 3)
    return image, depth.reshape(HEIGHT, WIDTH), label.reshape(HEIGHT, WIDTH).astype(np.int32)


def pixel_rays(du: float, dv: float) -> Array:
    """(H * W, 3) rays with z = 1 through the pixel centres shifted by (du, dv) pixels."""
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    x = (u + du - (WIDTH - 1) / 2) / FOCAL
    y = (v + dv - (HEIGHT - 1) / 2) / FOCAL
    return np.stack([x, y, np.ones_like(x)], -1).reshape(-1, 3)


def shade(rays: Array, poses: list[Array], rng: np.random.Generator) -> Array:
    """Linear RGB of rays from the eye, with a disk light, soft shadows, sky light, contact shadows and gloss."""
    t, label = cast(EYE, rays, poses)
    t = np.where(np.isfinite(t), t, 10.0)
    points = EYE + rays * t[:, None]
    normal, base, gloss = np.tile([0.0, 0.0, 1.0], (len(points), 1)), np.zeros_like(points), np.zeros(len(points))
    table = label <= 0
    base[table] = wood(points[table, :2])
    gloss[table] = 0.05
    contact = np.ones(len(points))
    for index, (obj, world_T_object) in enumerate(zip(OBJECTS, poses, strict=True), start=1):
        mask = label == index
        R, center = world_T_object[:3, :3], world_T_object[:3, 3]
        local = (points[mask] - center) @ R
        local_normal = normals(obj, local)
        base[mask], gloss[mask] = PAINT[obj.name](local, local_normal, np.array(obj.size))
        normal[mask] = local_normal @ R.T
        # Sky light is occluded where the table and an object are close to each other.
        outside = np.maximum(np.abs((points[table] - center) @ R) - np.array(obj.size), 0)
        gap = (
            np.linalg.norm(outside[:, :2], axis=-1)
            if obj.kind == "box"
            else np.maximum(np.linalg.norm((points[table] - center)[:, :2], axis=-1) - obj.size[0] * 0.8, 0)
        )
        contact[table] *= 1 - 0.50 * np.exp(-gap / 0.014)
        contact[mask] *= 1 - 0.45 * np.exp(-points[mask, 2] / 0.016)
    lamp = LAMP + _on_disk(rng, len(points)) * LAMP_RADIUS
    to_lamp = lamp - points
    distance, blocker = cast(points + 2e-5 * normal, to_lamp, poses)
    lit = ~((distance < 1) & (blocker > 0))
    toward = to_lamp / np.linalg.norm(to_lamp, axis=-1, keepdims=True)
    facing = np.clip((normal * toward).sum(-1), 0, 1) * lit
    half = toward - rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    half /= np.linalg.norm(half, axis=-1, keepdims=True)
    shine = gloss * lit * np.clip((normal * half).sum(-1), 0, 1) ** 60
    sky = (0.26 + 0.16 * normal[:, 2] + 0.10 * np.clip(-normal[:, 1], 0, 1)) * contact
    warm, cool = np.array([1.0, 0.95, 0.87]), np.array([0.93, 0.97, 1.05])
    return np.asarray(base * (0.86 * facing[:, None] * warm + sky[:, None] * cool) + shine[:, None] * warm)


def _on_disk(rng: np.random.Generator, count: int) -> Array:
    angle, radius = rng.uniform(0, 2 * np.pi, count), np.sqrt(rng.uniform(size=count))
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), np.zeros(count)], -1)


def measure(depth: Array, rng: np.random.Generator) -> NDArray[np.uint16]:
    """Simulate a depth camera: noise that grows with distance, holes at depth edges, quantisation."""
    sigma = 0.0006 + 0.0012 * (depth - 0.4) ** 2
    coarse = ndimage.gaussian_filter(rng.normal(size=depth.shape), 1.0)
    noisy = depth + sigma * coarse / coarse.std()
    edge = ndimage.maximum_filter(depth, 3) - ndimage.minimum_filter(depth, 3) > 0.02
    ragged = ndimage.gaussian_filter(rng.uniform(size=depth.shape), 1.0)
    hole = edge & (ragged > np.quantile(ragged, 0.45))
    return np.where(hole, 0, np.rint(noisy * DEPTH_SCALE)).astype(np.uint16)


def look_at(eye: Array, target: Array) -> Array:
    """world_T_camera with x right, y down, z forward."""
    z = (target - eye) / np.linalg.norm(target - eye)
    x = np.cross(z, [0, 0, 1])
    x /= np.linalg.norm(x)
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = np.stack([x, np.cross(z, x), z], axis=1), eye
    return out


def main() -> None:
    """Write the pair folder and its ground truth."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    default = Path(__file__).resolve().parents[1] / "src" / "objectflow" / "demo" / "pair"
    parser.add_argument("--out", type=Path, default=default)
    out: Path = parser.parse_args().out
    out.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(SEED)
    world_T_camera = look_at(EYE, TARGET)
    poses = [[obj.pose(current=current) for obj in OBJECTS] for current in (False, True)]
    truth: dict[str, Array] = {}
    for index in (0, 1):
        color, depth, labels = render(world_T_camera, poses[index], rng)
        cv2.imwrite(str(out / f"color{index}.jpg"), color[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 95])
        cv2.imwrite(str(out / f"depth{index}.png"), measure(depth, rng), [cv2.IMWRITE_PNG_COMPRESSION, 9])
        truth[f"labels{index}"] = labels.astype(np.uint8)
    camera_T_world = np.linalg.inv(world_T_camera)
    motions = [camera_T_world @ p @ np.linalg.inv(c) @ world_T_camera for p, c in zip(*poses, strict=True)]
    centers = [(camera_T_world @ c)[:3, 3] for c in poses[1]]
    truth |= {
        "prev_T_curr": np.array(motions),
        "centers": np.array(centers),
        "names": np.array([obj.name for obj in OBJECTS]),
        "moving": np.array([obj.displacement != (0.0, 0.0) for obj in OBJECTS]),
    }
    np.savez_compressed(out / "truth.npz", **truth)  # type: ignore[arg-type]
    camera = {"width": WIDTH, "height": HEIGHT, "fx": FOCAL, "fy": FOCAL}
    camera |= {"cx": (WIDTH - 1) / 2, "cy": (HEIGHT - 1) / 2, "depth_scale": DEPTH_SCALE}
    (out / "camera.json").write_text(json.dumps(camera) + "\n")


if __name__ == "__main__":
    main()
