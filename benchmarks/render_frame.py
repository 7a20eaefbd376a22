"""Seconds a frame of the ray-traced renderer, beside MuJoCo's own OpenGL one: `python benchmarks/render_frame.py`.

Both draw the same scenes of the generator, at the same size: colour, depth and labels of two frames a scene, with the
objects where the scene puts them. The OpenGL renderer runs in software (OSMesa), in a process of its own, and is left
out where OSMesa is not installed. Every step is counted, from a compiled model to arrays in memory.
"""

from __future__ import annotations

import dataclasses
import multiprocessing
import os
import platform
import statistics
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import tyro
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table


@dataclasses.dataclass
class Settings:
    """Times the rendering of generated scenes."""

    width: int = 320
    """Pixels; the height is three quarters of it."""
    scenes: int = 12
    """Scenes, after one to warm up."""
    frames: int = 2
    """Frames of each scene."""
    seed: int = 0
    """Of the scenes."""
    device: str = "cpu"
    """Of the ray-traced renderer: cpu (one core) or cuda."""


Scene = tuple[Any, NDArray[np.float64], NDArray[np.float64]]


def make_scenes(settings: Settings) -> list[Scene]:
    """Models with world_T_objects (F, N, 4, 4) and world_T_cameras (1, 4, 4)."""
    from objectflow.synth.mjcf import build_model
    from objectflow.synth.objects import open_library
    from objectflow.synth.scene import SceneSettings, draw_scene

    library = open_library(None)
    result = []
    for number in range(settings.scenes + 1):
        rng = np.random.default_rng((settings.seed, number))
        scene, models = draw_scene(rng, library, "train", SceneSettings())
        model = build_model(scene, models)
        world_T_objects = np.repeat(scene.start_poses[None], settings.frames, axis=0)
        # No two frames alike: each is a centimetre lower than the one before.
        world_T_objects[..., 2, 3] -= 0.01 * np.arange(settings.frames)[:, None]
        result.append((model, world_T_objects, scene.camera_poses))
    return result


def time_scenes(scenes: list[Scene], render: Callable[[Scene], object], frames: int) -> tuple[float, float]:
    """Median and slowest seconds a frame; the first scene only warms up."""
    seconds = []
    for scene in scenes:
        start = time.perf_counter()
        render(scene)
        seconds.append((time.perf_counter() - start) / frames)
    return statistics.median(seconds[1:]), max(seconds[1:])


def time_ray_tracer(settings: Settings, samples: int) -> tuple[float, float]:
    from objectflow.synth.render import Renderer

    renderer = Renderer(settings.width, settings.width * 3 // 4, samples=samples, device=settings.device)
    return time_scenes(make_scenes(settings), lambda scene: renderer.render(*scene), settings.frames)


def time_opengl(settings: Settings, samples: int, queue: multiprocessing.Queue[tuple[float, float] | str]) -> None:
    """Puts the times, or why there are none."""
    os.environ["MUJOCO_GL"] = "osmesa"
    try:
        import mujoco

        probe = mujoco.MjModel.from_xml_string("<mujoco><worldbody><light/></worldbody></mujoco>")
        mujoco.Renderer(probe, 8, 8).close()
    except (ImportError, AttributeError, OSError, RuntimeError) as error:
        # PyOpenGL says it with an AttributeError when the library is not there.
        queue.put(f"OSMesa or PyOpenGL is not installed ({type(error).__name__})")
        return

    def render(scene: Scene) -> None:
        model, world_T_objects, _ = scene
        model.vis.quality.offsamples = samples if samples > 1 else 0
        data = mujoco.MjData(model)
        with mujoco.Renderer(model, settings.width * 3 // 4, settings.width) as renderer:
            for poses in world_T_objects:
                for number, pose in enumerate(poses, 1):
                    joint = data.body(f"obj_{number}").jntadr[0]
                    address = model.jnt_qposadr[joint]
                    data.qpos[address : address + 3] = pose[:3, 3]
                    mujoco.mju_mat2Quat(data.qpos[address + 3 : address + 7], pose[:3, :3].ravel())
                mujoco.mj_forward(model, data)
                renderer.update_scene(data, camera="camera")
                renderer.render()
                renderer.enable_depth_rendering()
                renderer.render()
                renderer.disable_depth_rendering()
                renderer.enable_segmentation_rendering()
                renderer.render()
                renderer.disable_segmentation_rendering()

    queue.put(time_scenes(make_scenes(settings), render, settings.frames))


def main(settings: Settings) -> None:
    context = multiprocessing.get_context("spawn")
    size = f"{settings.width}x{settings.width * 3 // 4}"
    table = Table(title=f"{size}, {settings.scenes} scenes, {platform.machine()}, Python {platform.python_version()}")
    for column in ("renderer", "samples", "median s a frame", "slowest s a frame"):
        table.add_column(column, justify="left" if column == "renderer" else "right")
    notes = []
    for samples in (1, 4):
        median, slowest = time_ray_tracer(settings, samples)
        table.add_row(f"mujoco-warp, {settings.device}", str(samples), f"{median:.3f}", f"{slowest:.3f}")
        queue: multiprocessing.Queue[tuple[float, float] | str] = context.Queue()
        process = context.Process(target=time_opengl, args=(settings, samples, queue))
        process.start()
        answer = queue.get()
        process.join()
        if isinstance(answer, str):
            notes.append(f"No figures for MuJoCo's OpenGL renderer: {answer}.")
        else:
            table.add_row("MuJoCo OpenGL, OSMesa", str(samples), f"{answer[0]:.3f}", f"{answer[1]:.3f}")
    console = Console(width=110)
    console.print(table)
    for note in dict.fromkeys(notes):
        console.print(note)


if __name__ == "__main__":
    main(tyro.cli(Settings))
