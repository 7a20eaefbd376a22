"""Images of a scene: colour with textures and shadows, planar depth and labels, ray-traced by mujoco-warp."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from objectflow.errors import DatasetError, ObjectflowError
from objectflow.synth.physics.mjcf import VISIBLE_GROUP
from objectflow.synth.rendering.camera_rays import pixel_rays
from objectflow.synth.rendering.placement import Placement, object_numbers
from objectflow.synth.rendering.warp_scene import WarpData, WarpModel, tighten_bounds
from objectflow.synth.rendering.warp_setup import cycles_freed, find_warp_device, import_tracer, quiet
from objectflow.synth.scenes.scene_data import Light
from objectflow.typing import Float32Array, Int64Array, LabelImage, UInt8Array

DEPTH_CLIP = float(2**20)
"""Depth in metres at which mujoco-warp clips; a power of two, so that its scaling is exact."""
LIT_IN_SHADOW = 0.0
"""Share of a light in its own shadow, 0..1; shadows are lit by the lights' ambient parts alone."""
BACKDROP = (0.45, 0.46, 0.48, 1.0)
"""RGBA colour of rays that hit nothing, 0..1."""

Device = Literal["cpu", "cuda"]


@dataclass(frozen=True, eq=False)
class RenderedFrames:
    """F frames of a scene, each rendered from C cameras."""

    color: UInt8Array
    """(F, C, H, W, 3) RGB."""
    depth: Float32Array
    """(F, C, H, W) planar z at the pixel's centre, metres; 0 where nothing is hit."""
    labels: LabelImage
    """(F, C, H, W) from the same ray as depth: k = object k, 0 = background."""


class Renderer:
    """Renders scenes at one image size. Use one instance for all scenes: its kernel is compiled once.

    Args:
        width, height: image size, pixels.
        samples: colour rays per pixel, 1 or 4. The first goes through the pixel's centre and also gives depth and
            label; the other three are around it. Display values are averaged, because the renderer's light is not
            linear either.
        device: "cpu" (one core) or "cuda".

    Attributes:
        kernels: the compiled kernels, by the properties of a scene that are compiled into them.

    Raises:
        MissingExtraError: mujoco-warp is not installed.
        ObjectflowError: CUDA is not available, or an unsupported number of samples.
    """

    def __init__(self, width: int, height: int, *, samples: int = 1, device: Device = "cpu") -> None:
        if samples not in (1, 4):
            raise ObjectflowError(f"a pixel has 1 or 4 colour samples, not {samples}")
        self._width, self._height, self._samples = width, height, samples
        self._warp, self._tracer = import_tracer()
        self._device = find_warp_device(self._warp, device)
        self.kernels: dict[Any, Any] = {}

    def render(
        self, model: Any, world_T_objects: NDArray[np.floating], world_T_cameras: NDArray[np.floating]
    ) -> RenderedFrames:
        """Render every frame from every camera.

        Args:
            model: a `mujoco.MjModel` with one free body per object, named obj_1..obj_N, visible geoms in group 0, and
                a camera named `camera`, which provides the intrinsics. Its lights are used, its headlight is not.
            world_T_objects: (F, N, 4, 4) poses of the objects, metres.
            world_T_cameras: (C, 4, 4) poses of the cameras, x right, y down, z forward, metres.

        Raises:
            DatasetError: the number of poses does not match the model.
        """
        numbers = object_numbers(model)
        frames, cameras = len(world_T_objects), len(world_T_cameras)
        expected = (frames, int(numbers.max(initial=0)), 4, 4)
        if world_T_objects.shape != expected or world_T_cameras.shape != (cameras, 4, 4):
            raise DatasetError(
                f"object poses {world_T_objects.shape} and camera poses {world_T_cameras.shape} do not fit the scene: "
                f"it needs {expected} and {(cameras, 4, 4)}"
            )
        placement = Placement.of(model, numbers, world_T_objects, world_T_cameras)
        return self._render(model, numbers, placement, (frames, cameras, self._height, self._width))

    def render_each(
        self,
        model: Any,
        world_T_objects: NDArray[np.floating],
        world_T_cameras: NDArray[np.floating],
        lights: Sequence[Sequence[Light]],
    ) -> RenderedFrames:
        """Render B images of one scene at once, each with its own poses, camera and light.

        Args:
            model: see `render`.
            world_T_objects: (B, N, 4, 4) poses of the objects, metres.
            world_T_cameras: (B, 4, 4) poses of the cameras, x right, y down, z forward, metres.
            lights: the lamps of each image, as many as the model was built with.

        Returns:
            B frames of one camera each.

        Raises:
            DatasetError: the number of poses or lamps does not match the model.
        """
        numbers = object_numbers(model)
        images, lamps = len(world_T_cameras), int(np.sum(model.light_active))
        expected = (images, int(numbers.max(initial=0)), 4, 4)
        if world_T_objects.shape != expected or [len(one) for one in lights] != [lamps] * images:
            raise DatasetError(
                f"object poses {world_T_objects.shape} and {[len(one) for one in lights]} lamps do not fit the scene: "
                f"it needs {expected} and {lamps} lamps in each image"
            )
        placement = Placement.each(model, numbers, world_T_objects, world_T_cameras, lights)
        return self._render(model, numbers, placement, (images, 1, self._height, self._width))

    def _render(
        self, model: Any, numbers: Int64Array, placement: Placement, shape: tuple[int, int, int, int]
    ) -> RenderedFrames:
        with cycles_freed(), quiet(self._warp), self._warp.ScopedDevice(self._device):
            color, depth, geoms = self._trace(model, placement)
        # Geom -1, nothing hit, indexes the appended 0.
        labels = np.append(numbers, 0).astype(np.int32)[geoms]
        return RenderedFrames(color.reshape(*shape, 3), depth.reshape(shape), labels.reshape(shape))

    def _trace(self, model: Any, placement: Placement) -> tuple[UInt8Array, Float32Array, LabelImage]:
        """Render B images: colour (B, H, W, 3), depth (B, H, W) and geom number (B, H, W), -1 = none."""
        wp, tracer = self._warp, self._tracer
        worlds = len(placement.camera_position)
        on_device, data = WarpModel(tracer, wp, model, placement.light_colors), WarpData.of(wp, placement)
        context = self._create_context(model, worlds)
        tracer.refit_bvh(on_device, data, context)
        tighten_bounds(model, placement, context)
        tracer.render(on_device, data, context)
        self.kernels.setdefault(_kernel_key(model, context), context._megakernel)

        shape = (worlds, self._height, self._width)
        color = wp.empty(shape, dtype=wp.vec3)
        depth = wp.empty(shape, dtype=wp.float32)
        geoms = wp.empty(shape, dtype=wp.vec2i)
        tracer.get_rgb(context, 0, color)
        tracer.get_depth(context, 0, DEPTH_CLIP, depth)
        tracer.get_segmentation(context, 0, geoms)
        return (
            np.rint(color.numpy() * 255).astype(np.uint8),
            depth.numpy() * np.float32(DEPTH_CLIP),
            geoms.numpy()[..., 0],
        )

    def _create_context(self, model: Any, worlds: int) -> Any:
        # The context steps the model once from its initial state. All constraints are disabled meanwhile, because
        # objects may overlap there.
        flags = int(model.opt.disableflags)
        model.opt.disableflags = -1
        try:
            context = self._new_context(model, worlds)
        finally:
            model.opt.disableflags = flags
        # These values are compiled into the kernel and differ between scenes; constants that suit all scenes avoid
        # recompilation. The depth range only culls (0 disables it), and the rays are replaced below.
        context.znear, context.zfar = 1.0, 0.0
        context.headlight_active = False
        context.headlight_ambient = context.headlight_diffuse = context.headlight_specular = self._warp.vec3(0.0)
        context.light_attenuation_is_default, context.has_spot_lights = False, True
        context.ray.assign(pixel_rays(model, self._width, self._height, self._samples))
        # The kernel object is reused as well: creating it again leaks memory, even if its code is already compiled.
        context._megakernel = self.kernels.get(_kernel_key(model, context))
        return context

    def _new_context(self, model: Any, worlds: int) -> Any:
        return self._tracer.create_render_context(
            model,
            nworld=worlds,
            cam_res=(self._width, self._height),
            cam_active=["camera"],
            render_rgb=True,
            render_depth=True,
            render_seg=True,
            use_textures=True,
            use_shadows=True,
            use_fast_math=False,
            enabled_geom_groups=[VISIBLE_GROUP],
            background_color=BACKDROP,
            shadow_light_fraction=LIT_IN_SHADOW,
            samples_per_pixel=round(self._samples**0.5),
        )


def _kernel_key(model: Any, context: Any) -> Any:
    """The properties in which the kernels of two scenes may still differ."""
    return context.geom_ray_types, int(model.nlight)
