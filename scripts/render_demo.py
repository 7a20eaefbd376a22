"""Draw the pair of frames that comes with the package: a table with six things, three of which moved.

    python scripts/render_demo.py                  # writes src/objectflow/demo/pair

Ray casting in numpy, independent of the package and of its generator. World frame: metres, z up, the table at z = 0.
Rays are `t * (x, y, 1)` in the camera frame, so that `t` is the planar depth. Colours are linear until the end.
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
SAMPLES = 4  # per pixel and axis, for the colour; depth and labels are those of the pixel's centre
DEPTH_SCALE = 1000
SEED = 7
EYE, TARGET = np.array([0.03, -0.54, 0.45]), np.array([0.02, 0.035, 0.035])
LAMP, LAMP_RADIUS = np.array([-0.55, -0.35, 1.15]), 0.09


@dataclass(frozen=True)
class Thing:
    """A box (half sizes), an upright can (radius, radius, half height) or a ball (radius), and where it stands."""

    name: str
    kind: str
    size: tuple[float, float, float]
    xy: tuple[float, float]
    turn: float  # degrees about the vertical, in the current frame
    moved: tuple[float, float] = (0.0, 0.0)  # metres on the table, previous to current
    turned: float = 0.0  # degrees, previous to current
    rolled: bool = False  # a ball turns about the horizontal axis that its way demands

    def pose(self, *, current: bool) -> Array:
        """world_T_object in one of the two frames."""
        xy = np.array(self.xy) - (0 if current else np.array(self.moved))
        turn = self.turn - (0 if current else self.turned)
        out = np.eye(4)
        out[:3, :3] = Rotation.from_euler("z", turn, degrees=True).as_matrix()
        if self.rolled and not current:
            way = np.array([*self.moved, 0.0])
            axis = np.cross([0, 0, 1], way) / self.size[0]
            out[:3, :3] = Rotation.from_rotvec(-axis).as_matrix() @ out[:3, :3]
        out[:3, 3] = [*xy, self.size[2]]
        return out


THINGS = (
    Thing("cereal box", "box", (0.060, 0.022, 0.085), (-0.150, 0.160), 14),
    Thing("tea box", "box", (0.048, 0.034, 0.034), (0.010, -0.030), 28, moved=(0.045, -0.020), turned=22),
    Thing("can", "can", (0.033, 0.033, 0.050), (0.165, 0.120), 40, moved=(0.030, 0.030), turned=-18),
    Thing("ball", "ball", (0.042, 0.042, 0.042), (-0.150, -0.060), 35, moved=(0.019, 0.011), rolled=True),
    Thing("book", "box", (0.062, 0.085, 0.011), (0.235, -0.075), -12),
    Thing("jar", "can", (0.038, 0.038, 0.030), (0.020, 0.205), 0),
)


def cast(origin: Array, rays: Array, poses: list[Array]) -> tuple[Array, Array]:
    """The nearest hit of world rays (N, 3) from origins (N, 3) or (3,): distance in ray lengths (inf), label (N,).

    Label 0 is the table; -1 is nothing.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        t = np.broadcast_to(origin, rays.shape)[:, 2] / -rays[:, 2]
    label = np.where(t > 1e-6, 0, -1)
    nearest = np.where(t > 1e-6, t, np.inf)
    for index, (thing, world_T_object) in enumerate(zip(THINGS, poses, strict=True), start=1):
        R, center = world_T_object[:3, :3], world_T_object[:3, 3]
        o, d = (np.broadcast_to(origin, rays.shape) - center) @ R, rays @ R
        # Most rays pass far from a thing: test its sphere first.
        reach = float(np.linalg.norm(thing.size))
        closest = o - d * ((o * d).sum(-1) / (d * d).sum(-1))[:, None]
        near = np.nonzero((closest**2).sum(-1) < reach**2)[0]
        hit = INTERSECT[thing.kind](o[near], d[near], np.array(thing.size))
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


def normals(thing: Thing, points: Array) -> Array:
    """Outward normals in the object frame at surface points in the object frame."""
    if thing.kind == "ball":
        return points / thing.size[0]
    relative = points / np.array(thing.size)
    out = np.zeros_like(points)
    if thing.kind == "box":
        axis = np.abs(relative).argmax(-1)
        out[np.arange(len(out)), axis] = np.sign(relative[np.arange(len(out)), axis])
        return out
    lid = np.abs(relative[:, 2]) > 0.9995
    out[lid, 2] = np.sign(relative[lid, 2])
    out[~lid, :2] = points[~lid, :2] / thing.size[0]
    return out


def render(world_T_camera: Array, poses: list[Array], rng: np.random.Generator) -> tuple[Array, Array, Array]:
    """Colour (H, W, 3) uint8 RGB, planar depth (H, W) metres, labels (H, W) int32."""
    depth, label = cast(EYE, _rays(0.0, 0.0) @ world_T_camera[:3, :3].T, poses)
    light = np.zeros((HEIGHT * WIDTH, 3))
    for i in range(SAMPLES):
        for j in range(SAMPLES):
            du, dv = (np.array([i, j]) + rng.uniform(size=2)) / SAMPLES - 0.5
            light += shade(_rays(du, dv) @ world_T_camera[:3, :3].T, poses, rng)
    light /= SAMPLES**2
    light = light / (1 + 0.12 * light)  # keep highlights from clipping hard
    color = np.clip(light, 0, 1) ** (1 / 2.2) * 255 + rng.normal(0, 1.2, light.shape)
    image = np.clip(np.rint(color), 0, 255).astype(np.uint8).reshape(HEIGHT, WIDTH, 3)
    return image, depth.reshape(HEIGHT, WIDTH), label.reshape(HEIGHT, WIDTH).astype(np.int32)


def _rays(du: float, dv: float) -> Array:
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    x = (u + du - (WIDTH - 1) / 2) / FOCAL
    y = (v + dv - (HEIGHT - 1) / 2) / FOCAL
    return np.stack([x, y, np.ones_like(x)], -1).reshape(-1, 3)


def shade(rays: Array, poses: list[Array], rng: np.random.Generator) -> Array:
    """Linear RGB of rays from the eye: a round lamp with soft shadows, a pale sky, dark contacts, a little gloss."""
    t, label = cast(EYE, rays, poses)
    t = np.where(np.isfinite(t), t, 10.0)
    points = EYE + rays * t[:, None]
    normal, base, gloss = np.tile([0.0, 0.0, 1.0], (len(points), 1)), np.zeros_like(points), np.zeros(len(points))
    table = label <= 0
    base[table] = wood(points[table, :2])
    gloss[table] = 0.05
    contact = np.ones(len(points))
    for index, (thing, world_T_object) in enumerate(zip(THINGS, poses, strict=True), start=1):
        mine = label == index
        R, center = world_T_object[:3, :3], world_T_object[:3, 3]
        local = (points[mine] - center) @ R
        local_normal = normals(thing, local)
        base[mine], gloss[mine] = PAINT[thing.name](local, local_normal, np.array(thing.size))
        normal[mine] = local_normal @ R.T
        # Ground near a thing, and a thing near the ground, see less of the sky.
        away = np.maximum(np.abs((points[table] - center) @ R) - np.array(thing.size), 0)
        gap = (
            np.linalg.norm(away[:, :2], axis=-1)
            if thing.kind == "box"
            else np.maximum(np.linalg.norm((points[table] - center)[:, :2], axis=-1) - thing.size[0] * 0.8, 0)
        )
        contact[table] *= 1 - 0.50 * np.exp(-gap / 0.014)
        contact[mine] *= 1 - 0.45 * np.exp(-points[mine, 2] / 0.016)
    lamp = LAMP + _on_disk(rng, len(points)) * LAMP_RADIUS
    way = lamp - points
    distance, lit_label = cast(points + 2e-5 * normal, way, poses)
    lit = ~((distance < 1) & (lit_label > 0))
    toward = way / np.linalg.norm(way, axis=-1, keepdims=True)
    facing = np.clip((normal * toward).sum(-1), 0, 1) * lit
    half = toward - rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    half /= np.linalg.norm(half, axis=-1, keepdims=True)
    shine = gloss * lit * np.clip((normal * half).sum(-1), 0, 1) ** 60
    sky = (0.26 + 0.16 * normal[:, 2] + 0.10 * np.clip(-normal[:, 1], 0, 1)) * contact
    warm, cool = np.array([1.0, 0.95, 0.87]), np.array([0.93, 0.97, 1.05])
    return base * (0.86 * facing[:, None] * warm + sky[:, None] * cool) + shine[:, None] * warm


def _on_disk(rng: np.random.Generator, count: int) -> Array:
    angle, radius = rng.uniform(0, 2 * np.pi, count), np.sqrt(rng.uniform(size=count))
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), np.zeros(count)], -1)


def measure(depth: Array, rng: np.random.Generator) -> NDArray[np.uint16]:
    """What a depth camera makes of true depth: noise that grows with distance, holes at depth edges, whole units."""
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
    """Write the pair folder and its truth."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    default = Path(__file__).resolve().parents[1] / "src" / "objectflow" / "demo" / "pair"
    parser.add_argument("--out", type=Path, default=default)
    out: Path = parser.parse_args().out
    out.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(SEED)
    world_T_camera = look_at(EYE, TARGET)
    poses = [[thing.pose(current=current) for thing in THINGS] for current in (False, True)]
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
        "names": np.array([thing.name for thing in THINGS]),
        "moving": np.array([thing.moved != (0.0, 0.0) for thing in THINGS]),
    }
    np.savez_compressed(out / "truth.npz", **truth)  # type: ignore[arg-type]
    camera = {"width": WIDTH, "height": HEIGHT, "fx": FOCAL, "fy": FOCAL}
    camera |= {"cx": (WIDTH - 1) / 2, "cy": (HEIGHT - 1) / 2, "depth_scale": DEPTH_SCALE}
    (out / "camera.json").write_text(json.dumps(camera) + "\n")


if __name__ == "__main__":
    main()
