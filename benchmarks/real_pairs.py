"""Results of a method on real pairs against what is true there: `python benchmarks/real_pairs.py`.

Reads folders of pair folders. What is true comes from the `truth.npz` of a pair (labels1, prev_T_curr,
background_prev_T_curr, names; or labels, prev_T_curr, moved), or from `real_expectations.py`. Prints a row per pair,
and exits with 1 if a result is not as expected.
"""

from __future__ import annotations

import dataclasses
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

import objectflow
from objectflow import geometry
from objectflow.typing import BoolMask
from quarter_turns import turn_back, turn_frame
from real_expectations import EXPECTATIONS, Box, Expectation

ROOT = Path(__file__).resolve().parents[1]
SHARED = ROOT.parent / "shared"
MOVING_CAMERA = ("bin_1", "bin_2")
MIN_SCORE = 0.5
"""A mover with a higher score is judged: it must be a true one."""
MIN_FOUND_SCORE = 0.3
"""Score from which a mover counts as found."""
MIN_IOU = {"labels1": 0.5, "labels": 0.75}
"""IoU from which a true mover is found, with derived masks, whose borders are rough, and with rendered ones."""


@dataclasses.dataclass
class Settings:
    """Judges one method on real pairs."""

    data: tuple[Path, ...] = (SHARED / "data", SHARED / "data" / "real", SHARED / "cases")
    """Folders of pair folders; pairs of which nothing is known are left out."""
    method: str = "rigidmatch"
    """Name of the method."""
    only: tuple[str, ...] = ()
    """Parts of names: other pairs are left out."""
    quarters: int = 0
    """Number of quarter turns by which the frames are turned, as those of a camera that is mounted so."""
    pictures: Path | None = None
    """Folder for pictures with the outlines of every result."""


def main(settings: Settings) -> int:
    """Print the table; 1 if an expectation is not met."""
    table = Table(title=f"{settings.method} on real pairs")
    for column in ("pair", "s", "camera", "movers: score, pixels", "found", "met", "faults"):
        table.add_column(column, overflow="fold")
    failed, count = 0, 0
    for folder in find_pairs(settings):
        prev, curr = read_pair(folder)
        camera = "moving" if folder.name in MOVING_CAMERA else "auto"
        estimator = objectflow.load(settings.method, camera=camera)
        start = time.perf_counter()
        motion = estimator(turn_frame(prev, settings.quarters), turn_frame(curr, settings.quarters))
        motion = turn_back(motion, settings.quarters)
        seconds = time.perf_counter() - start
        truth = read_truth(folder, curr)
        verdict = judge_by_masks(motion, truth, curr) if truth else judge_by_boxes(motion, EXPECTATIONS[folder.name])
        movers = ", ".join(f"{obj.score:.2f} {obj.pixels}" for obj in motion.moving) or "none"
        table.add_row(
            folder.name,
            f"{seconds:.1f}",
            describe_camera(motion),
            movers,
            ", ".join(verdict.found),
            "no" if verdict.faults else "yes",
            "; ".join(verdict.faults),
        )
        failed, count = failed + bool(verdict.faults), count + 1
        if settings.pictures:
            draw(settings.pictures / f"{folder.name}.png", curr, motion, truth)
    Console(width=150).print(table)
    print(f"{count - failed} of {count} pairs as expected")
    return 1 if failed else 0


def find_pairs(settings: Settings) -> Iterator[Path]:
    """The pair folders of which something is known."""
    for data in settings.data:
        for folder in sorted(path.parent for path in data.glob("*/camera.json")):
            known = folder.name in EXPECTATIONS or (folder / "truth.npz").exists()
            chosen = not settings.only or any(part in folder.name for part in settings.only)
            if known and chosen and any(folder.glob("color0.*")):
                yield folder


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
    min_iou: float


def read_truth(folder: Path, curr: objectflow.RgbdFrame) -> Truth | None:
    if not (folder / "truth.npz").exists():
        return None
    z = np.load(folder / "truth.npz")
    name = "labels1" if "labels1" in z else "labels"
    labels = z[name].astype(np.int32)
    if "moved" in z:
        motions = dict(enumerate(z["prev_T_curr"]))
        names = {int(k): f"thing {k}" for k in np.unique(labels[labels > 0])}
        return Truth(labels, motions, {k: k in z["moved"] for k in names}, names, MIN_IOU[name])
    background = z["background_prev_T_curr"]
    motions = {k + 1: T for k, T in enumerate(z["prev_T_curr"])}
    names = {k + 1: str(name) or f"object {k + 1}" for k, name in enumerate(z["names"])}
    points = geometry.back_project(curr.depth, curr.camera)
    moving = {}
    for k, T in motions.items():
        center = np.median(points[(labels == k) & curr.valid], axis=0)
        displacement = np.linalg.norm(geometry.transform(T, center) - geometry.transform(background, center))
        moving[k] = bool(displacement > 0.005) and "static" not in names[k]
    return Truth(labels, motions, moving, names, MIN_IOU[name])


@dataclasses.dataclass
class Verdict:
    """What a result has found, and what is wrong with it."""

    found: list[str] = dataclasses.field(default_factory=list)
    faults: list[str] = dataclasses.field(default_factory=list)


def judge_by_masks(motion: objectflow.SceneMotion, truth: Truth, curr: objectflow.RgbdFrame) -> Verdict:
    """Compare a result with true masks and motions."""
    verdict, found = Verdict(), set[int]()
    points = geometry.back_project(curr.depth, curr.camera)
    for obj in motion.moving:
        mask = motion.labels == obj.id
        k, iou = overlap(mask, truth)
        if truth.moving[k] and iou >= truth.min_iou:
            found.add(k)
            seen = points[(truth.labels == k) & curr.valid]
            verdict.found.append(f"{truth.names[k]}: IoU {iou:.2f}, {describe_error(obj, truth.prev_T_curr[k], seen)}")
        elif obj.score > MIN_SCORE and np.isin(truth.labels[mask], _moving_labels(truth)).mean() < 0.5:
            verdict.faults.append(f"false mover {obj.id} ({obj.score:.2f})")
    verdict.faults += [f"missed: {truth.names[k]}" for k in _moving_labels(truth) if k not in found]
    return verdict


def _moving_labels(truth: Truth) -> list[int]:
    return [k for k, moves in truth.moving.items() if moves]


def judge_by_boxes(motion: objectflow.SceneMotion, expected: Expectation) -> Verdict:
    """Compare a result with what is known by eye."""
    verdict, shape = Verdict(), motion.labels.shape
    allowed = np.full(shape, expected.anywhere)
    for box in (*expected.allowed, *expected.required.values()):
        allowed |= inside(box, shape)
    judged = [obj for obj in motion.moving if obj.score > MIN_SCORE]
    for obj in judged:
        if allowed[motion.labels == obj.id].mean() < 0.5:
            verdict.faults.append(f"false mover {obj.id} ({obj.score:.2f})")
        if obj.displacement > expected.max_displacement:
            verdict.faults.append(f"{obj.id} is said to have moved by {obj.displacement:.2f} m")
    free = [obj.id for obj in motion.moving if obj.score > MIN_FOUND_SCORE]
    for name, box in expected.required.items():
        region = inside(box, shape)
        covers = {k: (region & (motion.labels == k)).sum() / region.sum() for k in free}
        covers = {k: cover for k, cover in covers.items() if region[motion.labels == k].mean() > 0.5}
        best = max(covers, key=lambda k: covers[k], default=None)
        if best is None or covers[best] < expected.min_cover:
            verdict.faults.append(f"missed: {name}")
        else:
            free.remove(best)
            verdict.found.append(f"{name}: {covers[best]:.2f} of its box")
    if motion.camera not in expected.cameras:
        verdict.faults.append(f"camera is {' or '.join(expected.cameras)}")
    return verdict


def inside(box: Box, shape: tuple[int, ...]) -> BoolMask:
    """(H, W) bool: the pixels of a box."""
    height, width = shape
    left, top, right, bottom = box
    out = np.zeros((height, width), np.bool_)
    out[round(top * height) : round(bottom * height), round(left * width) : round(right * width)] = True
    return out


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


def describe_error(obj: objectflow.ObjectMotion, true: np.ndarray, points: np.ndarray) -> str:
    """Error of a motion: of its rotation, and of the object's centre (points (N, 3) metres)."""
    center = center_of(points)
    angle = np.degrees(geometry.rotation_angle(obj.prev_T_curr[:3, :3] @ true[:3, :3].T))
    shift = np.linalg.norm(geometry.transform(obj.prev_T_curr, center) - geometry.transform(true, center))
    return f"{angle:.1f} deg, {1000 * shift:.1f} mm off"


def describe_camera(motion: objectflow.SceneMotion) -> str:
    if motion.camera_motion is None:
        return motion.camera
    shift = np.linalg.norm(motion.camera_motion[:3, 3])
    return f"{100 * shift:.1f} cm {np.degrees(geometry.rotation_angle(motion.camera_motion[:3, :3])):.1f} deg"


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
    sys.exit(main(tyro.cli(Settings)))
