"""Results of a method on real pairs, compared with derived ground truth: `python benchmarks/real_pairs.py`.

Reads a folder of pair folders, some with a `truth.npz` (labels0, labels1, prev_T_curr, background_prev_T_curr, names).
"""

from __future__ import annotations

import dataclasses
import time
from pathlib import Path

import cv2
import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

import objectflow
from objectflow import geometry

ROOT = Path(__file__).resolve().parents[1]
MOVING_CAMERA = ("bin_1", "bin_2")


@dataclasses.dataclass
class Settings:
    """Scores one method on real pairs."""

    data: Path = ROOT.parent / "shared" / "data"
    """Folder of pair folders."""
    method: str = "consensus"
    """Name of the method."""
    pictures: Path | None = None
    """Folder for pictures with the outlines of every result."""


def main(settings: Settings) -> None:
    table = Table(title=f"{settings.method} on {settings.data.name}")
    for column in (
        "pair",
        "s",
        "camera",
        "object",
        "pixels",
        "score",
        "moving",
        "truth",
        "IoU",
        "rotation error deg",
        "centre error mm",
    ):
        table.add_column(column)
    for folder in sorted(p.parent for p in settings.data.glob("*/camera.json")):
        prev, curr = read_pair(folder)
        camera = "moving" if folder.name in MOVING_CAMERA else "auto"
        estimator = objectflow.load(settings.method, camera=camera)
        start = time.perf_counter()
        motion = estimator(prev, curr)
        seconds = time.perf_counter() - start
        truth = read_truth(folder, curr)
        camera_text = "static" if motion.camera_motion is None else describe_motion(motion.camera_motion)
        rows = [describe_object(obj, motion, curr, truth) for obj in motion.objects]
        rows += [("-", "", "", "", f"missed: {name}", "", "", "") for name in missed(motion, truth)]
        for i, row in enumerate(rows or [("none", "", "", "", "", "", "", "")]):
            table.add_row(*((folder.name, f"{seconds:.2f}", camera_text) if i == 0 else ("", "", "")), *row)
        if settings.pictures:
            draw(settings.pictures / f"{folder.name}.png", curr, motion, truth)
    Console(width=150).print(table)


def read_pair(folder: Path) -> tuple[objectflow.RgbdFrame, objectflow.RgbdFrame]:
    camera, scale = objectflow.Camera.read(folder / "camera.json")
    prev, curr = (
        objectflow.RgbdFrame.read(
            next(folder.glob(f"color{k}.*")), folder / f"depth{k}.png", camera=camera, depth_scale=scale or 1000
        )
        for k in (0, 1)
    )
    return prev, curr


@dataclasses.dataclass
class Truth:
    """Ground truth of a `truth.npz`, with labels on the current frame."""

    labels: np.ndarray
    prev_T_curr: dict[int, np.ndarray]
    moving: dict[int, bool]
    names: dict[int, str]


def read_truth(folder: Path, curr: objectflow.RgbdFrame) -> Truth | None:
    if not (folder / "truth.npz").exists():
        return None
    z = np.load(folder / "truth.npz")
    background = z["background_prev_T_curr"]
    motions = {k + 1: T for k, T in enumerate(z["prev_T_curr"])}
    names = {k + 1: str(name) or f"object {k + 1}" for k, name in enumerate(z["names"])}
    labels = z["labels1"].astype(np.int32)
    points = geometry.back_project(curr.depth, curr.camera)
    moving = {}
    for k, T in motions.items():
        center = np.median(points[(labels == k) & curr.valid], axis=0)
        displacement = np.linalg.norm(geometry.transform(T, center) - geometry.transform(background, center))
        moving[k] = bool(displacement > 0.005) and "static" not in names[k]
    return Truth(labels, motions, moving, names)


def center_of(points: np.ndarray) -> np.ndarray:
    """The point at which translations are compared: the centre of a ball, otherwise the median of the visible points.

    The rolling of a ball is unknown; it affects the motion of surface points but not of the centre.
    """
    median = np.asarray(np.median(points, axis=0), dtype=np.float64)
    near = points[np.linalg.norm(points - median, axis=1) < 0.05].astype(np.float64)
    if len(near) < 0.8 * len(points):
        return median
    solution, *_ = np.linalg.lstsq(np.c_[2 * near, np.ones(len(near))], (near**2).sum(axis=1), rcond=None)
    center = np.asarray(solution[:3], dtype=np.float64)
    radius = float(np.sqrt(max(0.0, solution[3] + center @ center)))
    rmse = np.sqrt(np.mean((np.linalg.norm(near - center, axis=1) - radius) ** 2))
    return center if radius < 0.06 and rmse < 0.004 else median


def overlap(mask: np.ndarray, truth: Truth) -> tuple[int, float]:
    """The true object with the largest IoU with a mask, and the IoU."""
    scores = {k: (mask & (truth.labels == k)).sum() / (mask | (truth.labels == k)).sum() for k in truth.names}
    best = max(scores, key=lambda k: scores[k])
    return best, float(scores[best])


def describe_object(
    obj: objectflow.ObjectMotion, motion: objectflow.SceneMotion, curr: objectflow.RgbdFrame, truth: Truth | None
) -> tuple[str, ...]:
    displacement, angle = np.linalg.norm(obj.translation) * 100, np.degrees(np.linalg.norm(obj.rotation_vector))
    base = (
        f"{obj.id}: {displacement:.1f} cm {angle:.1f} deg",
        str(obj.pixels),
        f"{obj.score:.2f}",
        str(obj.moving),
    )
    if truth is None:
        return (*base, "", "", "", "")
    mask = motion.labels == obj.id
    k, iou = overlap(mask, truth)
    if iou == 0:
        return (*base, "none", "0", "", "")
    points = geometry.back_project(curr.depth, curr.camera)[(truth.labels == k) & curr.valid]
    center = center_of(points)
    true = truth.prev_T_curr[k]
    angle_error = np.degrees(geometry.rotation_angle(obj.prev_T_curr[:3, :3] @ true[:3, :3].T))
    shift = np.linalg.norm(geometry.transform(obj.prev_T_curr, center) - geometry.transform(true, center)) * 1000
    state = "moving" if truth.moving[k] else "STATIC"
    return (*base, f"{truth.names[k]} ({state})", f"{iou:.2f}", f"{angle_error:.1f}", f"{shift:.1f}")


def missed(motion: objectflow.SceneMotion, truth: Truth | None) -> list[str]:
    if truth is None:
        return []
    found = {
        overlap(motion.labels == obj.id, truth)[0]
        for obj in motion.objects
        if overlap(motion.labels == obj.id, truth)[1] > 0.2
    }
    return [name for k, name in truth.names.items() if truth.moving[k] and k not in found]


def describe_motion(prev_T_curr: np.ndarray) -> str:
    return (
        f"{np.linalg.norm(prev_T_curr[:3, 3]) * 100:.1f} cm "
        f"{np.degrees(geometry.rotation_angle(prev_T_curr[:3, :3])):.1f} deg"
    )


def draw(path: Path, curr: objectflow.RgbdFrame, motion: objectflow.SceneMotion, truth: Truth | None) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    canvas = cv2.cvtColor(curr.color, cv2.COLOR_RGB2BGR)
    colors = [(0, 0, 255), (255, 0, 0), (0, 255, 255), (255, 0, 255), (255, 255, 0), (0, 128, 255)]
    for obj in motion.objects:
        outlines, _ = cv2.findContours(
            (motion.labels == obj.id).astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE
        )
        cv2.drawContours(canvas, outlines, -1, colors[obj.id % 6], 2)
    if truth is not None:
        outlines, _ = cv2.findContours((truth.labels > 0).astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
        cv2.drawContours(canvas, outlines, -1, (0, 255, 0), 1)
    cv2.imwrite(str(path), canvas)


if __name__ == "__main__":
    main(tyro.cli(Settings))
