"""Accuracy with a moving camera: `python benchmarks/moving_camera.py`.

Uses the analytic scenes of the tests, each with a static camera and with a camera that moved by 1-5 degrees and
1-5 cm. The current frame and the objects' motions in the world are the same in both. Errors are those of the scene
flow on moving objects.
"""

from __future__ import annotations

import dataclasses
from typing import Any, cast

import numpy as np
import tyro
from rich.console import Console
from rich.table import Table
from scipy.spatial.transform import Rotation

import analytic
import objectflow
from objectflow import geometry
from objectflow.alignment.camera_estimate import estimate_camera
from objectflow.alignment.frame_pair import FramePair
from objectflow.methods.base import PairEstimator
from objectflow.methods.moving_camera import MovingCamera
from objectflow.methods.registry import find_class
from objectflow.typing import Float32Array, Float64Array


@dataclasses.dataclass
class Settings:
    """Compares methods with a static and with a moving camera."""

    methods: tuple[str, ...] = ("dense-flow", "pd-flow", "consensus")
    """Names of the methods."""
    scenes: int = 12
    """Number of scenes."""
    first_seed: int = 500
    """Seed of the first scene."""


def main(settings: Settings) -> None:
    """Render, estimate, print."""
    seeds = range(settings.first_seed, settings.first_seed + settings.scenes)
    motions = [draw_motion(seed) for seed in seeds]
    static = [analytic.make_scene(seed) for seed in seeds]
    moved = [analytic.make_scene(seed, camera_motion=motion) for seed, motion in zip(seeds, motions, strict=True)]
    table = Table(title=f"{settings.scenes} analytic scenes, masked EPE in cm")
    for column in ("method", "static camera", "moving", "moving, compensated", "times static"):
        table.add_column(column, justify="left" if column == "method" else "right")
    for name in settings.methods:
        method = load_static(name)
        errors = [
            np.mean([error(estimator(pair.prev, pair.curr).scene_flow, pair) for pair in pairs])
            for estimator, pairs in (
                (method, static),
                (method, moved),
                (MovingCamera(estimator=method, camera="moving"), moved),
            )
        ]
        table.add_row(name, *(f"{100 * value:.2f}" for value in errors), f"{errors[2] / errors[0]:.2f}")
    console = Console(width=110)
    console.print(table)
    shift, angle = zip(*(camera_error(pair, motion) for pair, motion in zip(moved, motions, strict=True)), strict=True)
    console.print(f"camera motion: median error {1000 * np.median(shift):.2f} mm, {np.median(angle):.3f} deg")


def load_static(name: str) -> PairEstimator:
    """A method for a static camera; some have no option for it."""
    has_camera = any(field.name == "camera" for field in dataclasses.fields(cast(Any, find_class(name))))
    return objectflow.load(name, **({"camera": "static"} if has_camera else {}))


def draw_motion(seed: int) -> Float64Array:
    """A random camera motion of 1-5 degrees and 1-5 cm."""
    rng = np.random.default_rng(seed)
    axis, direction = rng.normal(size=3), rng.normal(size=3)
    out = np.eye(4)
    out[:3, :3] = Rotation.from_rotvec(np.radians(rng.uniform(1, 5)) * axis / np.linalg.norm(axis)).as_matrix()
    out[:3, 3] = rng.uniform(0.01, 0.05) * direction / np.linalg.norm(direction)
    return out


def error(flow: Float32Array, pair: analytic.AnalyticPair) -> float:
    """Mean end-point error on the moving objects, metres."""
    mask = np.isin(pair.labels, sorted(pair.moving)) & np.isfinite(flow[..., 0])
    return float(np.linalg.norm(flow[mask] - pair.scene_flow[mask], axis=-1).mean())


def camera_error(pair: analytic.AnalyticPair, motion: Float64Array) -> tuple[float, float]:
    """Error of the estimated camera motion, metres and degrees."""
    found = estimate_camera(FramePair(pair.prev, pair.curr), camera="moving").prev_T_curr
    error = geometry.inverse(motion) @ (np.eye(4) if found is None else found)
    return float(np.linalg.norm(error[:3, 3])), float(np.degrees(geometry.rotation_angle(error[:3, :3])))


if __name__ == "__main__":
    main(tyro.cli(Settings))
