"""Seconds per frame of the ray tracer and of MuJoCo's OpenGL renderer: `python benchmarks/render_frame.py`.

Both render the same scenes at the same size: colour, depth and labels of textured objects that float above a floor,
with three lights that cast shadows. The OpenGL renderer runs in software (OSMesa) in a separate process, and is left
out if OSMesa is not installed. All steps from a compiled model to arrays in memory are measured. CPU seconds are
summed over all threads and do not depend on other load of the machine.
"""

from __future__ import annotations

import dataclasses
import multiprocessing
import os
import platform
import statistics
import time
from collections.abc import Callable
from typing import Any, Literal

import numpy as np
import tyro
from rich.console import Console
from rich.table import Table
from scipy.spatial.transform import Rotation

from objectflow.typing import Float64Array
from timing import time_each


@dataclasses.dataclass
class Settings:
    """Measures the rendering of scenes."""

    width: int = 320
    """Image width, pixels; the height is three quarters of it."""
    scenes: int = 12
    """Number of scenes, after one unmeasured scene."""
    objects: int = 15
    """Number of objects per scene."""
    frames: int = 2
    """Number of frames per scene."""
    seed: int = 0
    """Random seed."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Device of the ray tracer: cpu (one core) or cuda."""


PosedModel = tuple[Any, Float64Array, Float64Array]
"""A `mujoco.MjModel`, world_T_objects (F, N, 4, 4) and world_T_cameras (1, 4, 4)."""


def make_scenes(settings: Settings) -> list[PosedModel]:
    return [
        make_scene(np.random.default_rng((settings.seed, number)), settings) for number in range(settings.scenes + 1)
    ]


def make_scene(rng: np.random.Generator, settings: Settings) -> PosedModel:
    import mujoco

    from objectflow.synth.objects.procedural import ProceduralLibrary

    library = ProceduralLibrary()
    refs = library.refs("train")
    spec = mujoco.MjSpec()
    spec.visual.headlight.active = False
    mesh, square = mujoco.mjtGeom.mjGEOM_MESH, mujoco.mjtTexture.mjTEXTURE_2D
    for number in range(settings.objects + 1):
        texture = spec.add_texture(name=f"{number}", type=square, width=256, height=256, nchannel=3)
        blocks = rng.integers(0, 256, (32, 32, 3), dtype=np.uint8)
        texture.data = blocks.repeat(8, axis=0).repeat(8, axis=1).tobytes()
        spec.add_material(name=f"{number}").textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = f"{number}"
    world = spec.worldbody
    world.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 0.1], material="0")
    for number in range(4):
        place = [*rng.uniform(-1, 1, 2), rng.uniform(1, 2)]
        light = world.add_light(type=mujoco.mjtLightType.mjLIGHT_POINT, pos=place, active=number < 3, castshadow=True)
        light.ambient, light.diffuse = [0.1] * 3, [0.3] * 3
    poses = np.tile(np.eye(4), (settings.frames, settings.objects, 1, 1))
    for number in range(1, settings.objects + 1):
        model = library.load(refs[int(rng.integers(len(refs)))])
        spec.add_mesh(
            name=f"{number}",
            uservert=model.vertices.astype(np.float32).ravel(),
            userface=model.faces.ravel(),
            usertexcoord=model.uv.astype(np.float32).ravel(),
            inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL,
        )
        body = world.add_body(name=f"obj_{number}")
        body.add_freejoint()
        body.add_geom(type=mesh, meshname=f"{number}", material=f"{number}")
        for part, points in enumerate(model.parts):
            # The hulls are invisible, but scenes of the generator have them.
            spec.add_mesh(name=f"{number}_{part}", uservert=points.astype(np.float32).ravel())
            body.add_geom(type=mesh, meshname=f"{number}_{part}", group=3)
        poses[:, number - 1, :3, :3] = Rotation.random(settings.frames, random_state=rng).as_matrix()
        poses[:, number - 1, :3, 3] = rng.uniform((-0.15, -0.15, 0.03), (0.15, 0.15, 0.2), (settings.frames, 3))
    # 0.55 m from the centre of the scene, at an elevation of 45 degrees.
    camera = np.eye(4)
    camera[:3, :3] = Rotation.from_euler("x", -135, degrees=True).as_matrix()
    camera[:3, 3] = (0, -0.39, 0.44)
    world.add_camera(
        name="camera",
        pos=camera[:3, 3],
        xyaxes=[*camera[:3, 0], *-camera[:3, 1]],
        resolution=[320, 240],
        focal_pixel=[236.46] * 2,
        sensor_size=[0.32, 0.24],
    )
    return spec.compile(), poses, camera[None]


Times = tuple[float, float, float]
"""Median and maximum seconds per frame, and median CPU seconds per frame."""


def time_scenes(scenes: list[PosedModel], render: Callable[[PosedModel], object], frames: int) -> Times:
    """Measure all scenes but the first."""
    cpu: list[float] = []

    def render_and_count(scene: PosedModel) -> None:
        start = time.process_time()
        render(scene)
        cpu.append((time.process_time() - start) / frames)

    seconds = [each / frames for each in time_each(render_and_count, scenes)]
    return statistics.median(seconds), max(seconds), statistics.median(cpu[-len(seconds) :])


def time_ray_tracer(settings: Settings, samples: int) -> Times:
    from objectflow.synth.rendering.renderer import Renderer

    renderer = Renderer(settings.width, settings.width * 3 // 4, samples=samples, device=settings.device)
    return time_scenes(make_scenes(settings), lambda scene: renderer.render(*scene), settings.frames)


def time_opengl(settings: Settings, samples: int, queue: multiprocessing.Queue[Times | str]) -> None:
    """Put the times, or the reason why there are none, into the queue."""
    os.environ["MUJOCO_GL"] = "osmesa"
    try:
        import mujoco

        probe = mujoco.MjModel.from_xml_string("<mujoco><worldbody><light/></worldbody></mujoco>")
        mujoco.Renderer(probe, 8, 8).close()
    except (ImportError, AttributeError, OSError, RuntimeError) as error:
        # PyOpenGL raises AttributeError if the library is missing.
        queue.put(f"OSMesa or PyOpenGL is not installed ({type(error).__name__})")
        return

    def render(scene: PosedModel) -> None:
        model, world_T_objects, _ = scene
        model.vis.quality.offsamples = samples if samples > 1 else 0
        data = mujoco.MjData(model)
        with mujoco.Renderer(model, settings.width * 3 // 4, settings.width) as renderer:
            for poses in world_T_objects:
                for number, pose in enumerate(poses, 1):
                    joint = model.body(f"obj_{number}").jntadr[0]
                    address = model.jnt_qposadr[joint]
                    data.qpos[address : address + 3] = pose[:3, 3]
                    mujoco.mju_mat2Quat(data.qpos[address + 3 : address + 7], pose[:3, :3].ravel())
                mujoco.mj_kinematics(model, data)
                mujoco.mj_comPos(model, data)
                mujoco.mj_camlight(model, data)
                renderer.update_scene(data, camera="camera")
                renderer.render()
                renderer.enable_depth_rendering()
                renderer.render()
                renderer.disable_depth_rendering()
                renderer.enable_segmentation_rendering()
                renderer.render()
                renderer.disable_segmentation_rendering()

    queue.put(time_scenes(make_scenes(settings), render, settings.frames))


def add_row(table: Table, name: str, samples: int, times: Times) -> None:
    table.add_row(name, str(samples), *(f"{each:.3f}" for each in times))


def main(settings: Settings) -> None:
    context = multiprocessing.get_context("spawn")
    size = f"{settings.width}x{settings.width * 3 // 4}"
    table = Table(title=f"{size}, {settings.scenes} scenes, {platform.machine()}, Python {platform.python_version()}")
    for column in ("renderer", "samples", "median s/frame", "maximum s/frame", "CPU s/frame"):
        table.add_column(column, justify="left" if column == "renderer" else "right")
    notes = []
    for samples in (1, 4):
        add_row(table, f"mujoco-warp, {settings.device}", samples, time_ray_tracer(settings, samples))
        queue: multiprocessing.Queue[Times | str] = context.Queue()
        process = context.Process(target=time_opengl, args=(settings, samples, queue))
        process.start()
        process.join()
        answer = "it failed" if process.exitcode else queue.get()
        if isinstance(answer, str):
            notes.append(f"No figures for MuJoCo's OpenGL renderer: {answer}.")
        else:
            add_row(table, "MuJoCo OpenGL, OSMesa", samples, answer)
    console = Console(width=110)
    console.print(table)
    for note in dict.fromkeys(notes):
        console.print(note)


if __name__ == "__main__":
    main(tyro.cli(Settings))
